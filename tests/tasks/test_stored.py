"""What tasks store comes back as it was, or is found to be damaged."""

import math

import pytest
import torch

from catalog.errors import DamagedArtefactError
from lidarpainter_models.evaluation.score_tables import metric_values, score_rows
from tasks.json_files import read_json, write_json
from tasks.tensors import read_tensors, write_tensors


def test_tensors_and_metadata_come_back_bit_for_bit(tmp_path):
    generator = torch.Generator().manual_seed(0)
    arrays = {
        "a": torch.randn(3, 4, generator=generator, dtype=torch.float64).T,
        "b": torch.tensor([True, False]),
        "empty": torch.zeros(0, 3, dtype=torch.uint8),
    }
    metadata = {"schema": 1, "names": ["ä", "b"], "pi": math.pi}
    write_tensors(tmp_path / "x.safetensors", arrays, metadata)
    found, described = read_tensors(tmp_path / "x.safetensors")
    assert described == metadata
    assert found.keys() == arrays.keys()
    assert all(torch.equal(found[name], arrays[name]) for name in arrays)


@pytest.mark.parametrize(
    "content", [None, b"", b"not tensors", b"\x08\x00\x00\x00\x00\x00\x00\x00{}"]
)
def test_a_file_of_something_else_is_damaged(tmp_path, content):
    path = tmp_path / "x.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DamagedArtefactError, match="cannot be read"):
        read_tensors(path)


def test_json_has_no_infinity(tmp_path):
    write_json(tmp_path / "x.json", {"psnr": math.inf, "all": [math.nan, 1.5]})
    assert read_json(tmp_path / "x.json") == {"psnr": None, "all": [None, 1.5]}


SCORES = {
    "recorded": {
        "psnr": 29.5,
        "ssim": 0.9,
        "lpips": None,
        "lpips_reason": "no weights",
        "actors_psnr": 28.0,
        "num_views": 14,
        "depth_within_5_percent": 0.98,
        "recorded_poses": {"psnr": 28.0, "ssim": 0.88, "num_views": 14},
    },
    "novel": {"left-2m": {"psnr": 24.0, "ssim": 0.8, "depth_within_5_percent": 0.93}},
}


def test_every_number_has_its_truth_and_a_missing_one_its_reason():
    values = metric_values(SCORES)
    assert ("recorded", "recorded", "psnr", 29.5, None) in values
    assert ("recorded", "recorded", "lpips", None, "no weights") in values
    assert ("recorded-poses", "recorded", "ssim", 0.88, None) in values
    assert ("truth", "left-2m", "psnr", 24.0, None) in values
    assert ("depth", "left-2m", "depth_within_5_percent", 0.93, None) in values


def test_strips_are_numbers_of_their_own_protocol():
    strips = {"left": {"psnr": 25.0, "num_views": 14}, "back": {"psnr": None, "psnr_reason": "x"}}
    assert metric_values(strips) == [
        ("cross-camera", "left", "psnr", 25.0, None),
        ("cross-camera", "back", "psnr", None, "x"),
    ]


def test_the_table_puts_unpainted_beside_painted():
    rows = score_rows({**SCORES, "unpainted": SCORES})
    assert rows[0] == ["recorded, interpolated poses", 29.5, 29.5, 0.9, 0.9, 0.98, 0.98, 14]
    assert rows[2][:3] == ["recorded, inside actor boxes", 28.0, 28.0]
    assert rows[3][0] == "left-2m"
