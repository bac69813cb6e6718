"""Points of a sweep come out of a fleet, once each, and are drawn from the catalog alone."""

import re

import pytest
from commands import settings, succeed
from toy_store import SMALL, TOY_SCENE, write_toy_scene

from catalog.store import open_store

WAYS = ("preset", "no-painter", "first-fit")
pytestmark = pytest.mark.slow  # each worker imports everything anew
CHOICE = ("--only", ",".join(WAYS), "--seeds", "1", *settings(*SMALL))


@pytest.fixture(scope="module")
def charted(tmp_path_factory):
    """The store, what `chart --json` printed first, and its pictures' folder."""
    folder = tmp_path_factory.mktemp("sweep")
    write_toy_scene(folder / "store")
    result = chart(folder / "store", folder / "first")
    return folder / "store", result, folder


def chart(store, out):
    words = ("chart", TOY_SCENE, "--out", out, *CHOICE, "--json")
    return succeed("--store", store, *words).json


def test_every_configuration_is_a_point(charted):
    _, result, _ = charted
    points = {point["configuration"]: point for point in result["points"]}
    assert set(points) == set(WAYS)
    assert all(0 < point["recorded_psnr"] < 60 for point in points.values())
    assert all(0 < point["aside_depth"] <= 1 for point in points.values())
    first, whole = points["first-fit"], points["preset"]
    assert first["cpu_seconds"] < whole["cpu_seconds"]
    assert len({point["run_id"] for point in points.values()}) == 3


def test_what_points_share_is_made_once(charted):
    store, _, _ = charted
    kinds = [row["kind"] for row in open_store(store).tables.rows("artefacts")]
    assert kinds.count("observations") == 1
    assert kinds.count("gaussians") == 1 + 4  # the first fit, and two rounds of two ways


def test_points_that_are_done_are_only_drawn(charted):
    store, first, folder = charted
    again = chart(store, folder / "again")
    assert again["points"] == first["points"]
    assert again["says"] == first["says"]
    svg, png, page = (folder / "again" / f"chart.{suffix}" for suffix in ("svg", "png", "html"))
    assert svg.read_bytes() == (folder / "first" / "chart.svg").read_bytes()
    assert png.stat().st_size > 10_000
    text = page.read_text()
    assert "first-fit" in text
    assert not re.search(r'<(script|link|img)[^>]+(src|href)="?(https?:)?//', text)
