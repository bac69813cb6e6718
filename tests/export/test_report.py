"""The report is one safe, self-contained page that fits a desk and a telephone."""

import html
import json
import re
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import pytest
import torch
from chromium import found_browser
from tiny_street import tiny_street
from toy_street import ToyStreet

from lidarpainter_models.errors import WriteError
from lidarpainter_models.export.images import to_bytes, write_png
from lidarpainter_models.export.report import (
    Comparison,
    Plot,
    Report,
    Table,
    format_cell,
    plot_geometry,
    render_report,
)
from lidarpainter_models.export.run_page import Pictures, RunPage
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import SyntheticStreet, record_street

WIDTHS_PX = (1400, 400)
INPUTS = ("LiDAR", "warped recording", "painted at view time", "confidence")
RESULT = {
    "run_id": "0" * 16,
    "scene": "synthetic/street-0005",
    "preset": "preview",
    "painter": "nano",
    "split": "alternate",
    "rounds": 1,
    "num_gaussians": 5,
    "guidance": {},
}


def sample_report(title: str = "run") -> Report:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(90, 160, 3, generator=generator)
    views = [
        Comparison(
            title=f"{name}, front_camera, frame 3",
            before_rgb=image,
            after_rgb=1 - image,
            truth_rgb=truth,
            inputs=dict.fromkeys(INPUTS, image),
        )
        for name, truth in (("recorded", image), ("left-2m", None))
    ]
    columns = ["view", *(f"unpainted figure {number}" for number in range(12))]
    scores = Table(
        title="scores", columns=columns, rows=[["a" * 32, *[29.5] * 12], ["b", *[None] * 12]]
    )
    return Report(
        title=title,
        summary=["what the scene is", "what was done with it"],
        comparisons=views,
        tables=[scores],
        plots=[Plot(title="fit", x_label="step", y_label="dB", series={"train": [(0, 1), (5, 2)]})],
        facts={
            "Provenance": {"scene content": "0" * 64},
            "Settings": {f"fit.setting_{number}": "1" for number in range(125)},
        },
    )


def run_page(street=None, *, has_lidar=True, is_estimated=False, **changes):
    """The report about a run of the toy street, but for some of what the run printed."""
    if street is None:
        street = ToyStreet()
        street.manifest = {"counts": {"frames": 4, "images": 4, "points": 1000}}
        street.lidar_names, street.frame_timestamps_ns = ("top",), [0, 300_000_000]
    page = RunPage(
        result=RESULT | {"recorded": None} | changes,
        costs=[],
        provenance={},
        settings={"fit.steps": "40"},
        has_lidar=has_lidar,
        is_estimated=is_estimated,
    )
    return page.report(street, Pictures(), {}, {"processor": "abacus"})


def judged(**figures):
    """What a run printed whose scene was judged."""
    found = {"recorded": {"psnr": 1.0, "num_views": 3, **figures}, "novel": {}}
    return {**found, "unpainted": found}


class Elements(HTMLParser):
    """Start tags of a page with their attributes, by name."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: dict[str, list[dict[str, str]]] = {}
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.found.setdefault(tag, []).append(dict(attrs))


def test_every_picture_is_named_and_no_two_alike():
    found = Elements(render_report(sample_report())).found
    names = [image.get("alt") for image in found["img"]]
    assert len(names) == 2 * (2 + len(INPUTS)) + 1
    assert all(names)
    assert len(set(names)) == len(names)
    assert "recorded, front_camera, frame 3: truth" in names
    assert "left-2m, front_camera, frame 3: truth" not in names
    assert len(found["figcaption"]) == len(found["figure"])
    assert all(plot["aria-label"] for plot in found["svg"])


def test_confidence_is_as_large_as_the_images_beside_it():
    page = render_report(sample_report())
    (grid,) = set(re.findall(r"\.inputs { grid-template-columns: ([^;]*);", page))
    assert grid == "repeat(2, minmax(0, 1fr))"
    rows = re.findall(r'<div class="inputs">(.*?)</div>', page, re.DOTALL)
    assert [row.count("<figure>") for row in rows] == [len(INPUTS) + 1, len(INPUTS)]  # one truth


def test_a_page_says_how_far_each_stretch_can_be_trusted():
    figures = dict.fromkeys(("left_m", "right_m", "up_m", "ahead_m"), 1.5)
    stretch = figures | {"yaw_left_deg": 20.0, "yaw_right_deg": None, "from_m": 0.0, "to_m": 19.4}
    stretch |= {"first_frame": 0, "last_frame": 13, "recorded_db": 31.0, "recorded_confidence": 1.0}
    envelope = {
        "good_db": 25.0,
        "promised": 0.9,
        "cameras": ["front_camera"],
        "num_frames": 40,
        "calibration": {"record": "numbers made up"},
        "stretches": [stretch],
    }
    tables = run_page(envelope=envelope).tables
    (table,) = [one for one in tables if one.title == "Where it can be trusted"]
    assert len(table.columns) == len(table.rows[0])
    assert table.columns[-2:] == ["yaw left, degrees \u2191", "yaw right, degrees \u2191"]
    assert table.rows[0][0] == "0 to 19"
    assert table.rows[0][-2:] == [20.0, None]
    assert "40 frames" in table.note
    assert "numbers made up" in table.note


def test_view_that_nobody_recorded_says_that_it_has_no_truth():
    page = render_report(sample_report())
    assert page.count("Nobody took an image here") == 1


def test_many_settings_are_folded_up_and_few_facts_are_not():
    page = render_report(sample_report())
    assert page.count("<details>") == 1
    assert "<summary>125 entries</summary>" in page
    assert page.index("Provenance") < page.index("<details>") < page.index("fit.setting_124")


def test_page_begins_with_what_the_scene_is(tmp_path):
    scene = DrivingScene.open(record_street(SyntheticStreet(tiny_street()), tmp_path))
    report = run_page(scene, **judged())
    assert report.summary[0].startswith(
        "Sequence street-0005 of the dataset synthetic: 6 frames in 0.5 s; 12 images of 2 cameras "
        "(front_camera, side_camera); "
    )
    text = render_report(report)
    assert text.index("Sequence street-0005") < text.index("<h2>")
    assert "abacus" in text
    assert "fit.steps" in text


@pytest.mark.parametrize(
    ("has_lidar", "words"),
    [(True, "The LiDAR tells too little of the street"), (False, "No LiDAR swept")],
)
def test_a_page_says_that_points_were_estimated(has_lidar, words):
    for is_estimated in (True, False):
        said = run_page(has_lidar=has_lidar, is_estimated=is_estimated).verdict
        assert any(sentence.startswith(words) for sentence in said) == is_estimated


def test_actors_have_their_psnr_and_results_without_it_a_dash():
    cells = []
    for of_actors in ({"psnr_by_actor": {"car": {"psnr": 25.5, "num_pixels": 9}}}, {}):
        tables = run_page(**judged(**of_actors)).tables
        (table,) = [table for table in tables if table.title == "Actors"]
        cells.append(dict(zip(table.columns, table.rows[0], strict=True))["PSNR, dB \u2191"])
    assert cells == [25.5, None]


@pytest.fixture(scope="session")
def browser():
    return found_browser()


def laid_out(browser, page, folder):
    """Width of the content and how many images do not show, for each width of a window."""
    frames = "".join(
        f'<iframe width="{width_px}" height="900" srcdoc="{html.escape(page)}"></iframe>'
        for width_px in WIDTHS_PX
    )
    script = """
      const measured = [...document.querySelectorAll("iframe")].map(frame => {
        const page = frame.contentDocument, images = [...page.images];
        return [page.documentElement.scrollWidth, images.filter(i => !i.naturalWidth).length];
      });
      document.body.textContent = "measured" + JSON.stringify(measured) + "!";
    """
    file = folder / "frames.html"
    file.write_text(f"<body>{frames}<script>onload = () => {{ {script} }}</script>", "utf-8")
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom", file.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return json.loads(re.search(r"measured(\[.*\])!", done.stdout)[1])


def test_nothing_overflows_on_a_desk_or_a_telephone(browser, tmp_path):
    measured = laid_out(browser, render_report(sample_report("run " + "x" * 60)), tmp_path)
    for width_px, (content_px, num_broken) in zip(WIDTHS_PX, measured, strict=True):
        assert content_px <= width_px
        assert num_broken == 0


def test_page_loads_nothing_from_elsewhere():
    page = render_report(sample_report())
    assert "http" not in page
    assert page.count("data:image/jpeg;base64,") == 13


def test_figures_have_units_and_say_which_way_is_better():
    by_camera = {"front": {"psnr": 1.0, "ssim": 0.5, "num_views": 3}}
    tables = run_page(**judged(), recorded_by_camera=by_camera).tables
    judging = [table for table in tables if any("PSNR" in name for name in table.columns)]
    assert len(judging) == 3
    for table in judging:
        assert "higher is better" in table.note
        assert all("dB \u2191" in name for name in table.columns if "PSNR" in name)


def test_links_lead_to_what_is_there():
    page = render_report(replace(sample_report(), repeat=["lidarpainter view latest"]))
    targets = re.findall(r'href="([^"]*)"', page)
    assert targets
    assert all(target.startswith("#") and f'id="{target[1:]}"' in page for target in targets)


def test_hostile_names_are_escaped():
    page = render_report(sample_report(title="<script>alert(1)</script>"))
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page


def test_a_plot_shows_every_line():
    series = {f"refine-{number}": [(0, 1), (5, number)] for number in range(9)}
    plot = Plot(title="fit", x_label="step", y_label="dB", series=series)
    lines = plot_geometry(plot)["lines"]
    assert [line["label"] for line in lines] == list(series)
    assert len({line["colour"] for line in lines}) == 8


def test_missing_numbers_print_as_a_dash_and_numbers_shortly():
    shown = [format_cell(value) for value in (None, 1.23456, 123.456, 7, "x")]
    assert shown == ["-", "1.235", "123.5", "7", "x"]


def test_bytes_round_and_clamp():
    rgb = torch.tensor([[[-1.0, 0.5, 2.0]]])
    assert to_bytes(rgb).tolist() == [[[0, 128, 255]]]


def test_unwritable_place_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(WriteError, match="cannot write"):
        write_png(torch.zeros(2, 2, 3), tmp_path / "file" / "image.png")
