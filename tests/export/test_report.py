"""The report is one safe, self-contained page."""

import pytest
import torch

from lidarpainter_models.errors import StorageError
from lidarpainter_models.export.images import to_bytes, write_png
from lidarpainter_models.export.report import (
    Comparison,
    Plot,
    Report,
    Table,
    format_cell,
    render_report,
)


def sample_report(title: str = "run") -> Report:
    image = torch.rand(8, 12, 3, generator=torch.Generator().manual_seed(0))
    return Report(
        title=title,
        summary="a summary",
        comparisons=[
            Comparison(
                title="left-2m",
                before_label="render",
                before_rgb=image,
                after_label="painted",
                after_rgb=1 - image,
                inputs={"lidar": image},
            )
        ],
        tables=[Table(title="scores", columns=["view", "psnr"], rows=[["a", 29.5], ["b", None]])],
        plots=[Plot(title="fit", x_label="step", y_label="dB", series={"train": [(0, 1), (5, 2)]})],
        provenance={"software": "0.1.0"},
    )


def test_page_loads_nothing_from_elsewhere():
    page = render_report(sample_report())
    assert "http" not in page
    assert page.count("data:image/jpeg;base64,") == 3


def test_hostile_names_are_escaped():
    page = render_report(sample_report(title="<script>alert(1)</script>"))
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page


def test_missing_numbers_print_as_a_dash_and_numbers_shortly():
    assert [format_cell(value) for value in (None, 1.23456, 123.456, 7, "x")] == [
        "-",
        "1.235",
        "123.5",
        "7",
        "x",
    ]


def test_bytes_round_and_clamp():
    rgb = torch.tensor([[[-1.0, 0.5, 2.0]]])
    assert to_bytes(rgb).tolist() == [[[0, 128, 255]]]


def test_unwritable_place_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match="cannot write"):
        write_png(torch.zeros(2, 2, 3), tmp_path / "file" / "image.png")
