"""A run whose scene lives in a style: derived by a word, recalled, shown, and not painted."""

import numpy as np
import pytest
from commands import refuse, seen_image, succeed
from tiny_street import HEIGHT_PX, WIDTH_PX

PATH = ("--trajectory", "recorded", "--frames", "2:3")


def test_a_run_in_a_style_is_shown_in_it_and_leads_back(own_run, tmp_path):
    words = ("stylize", own_run.run_id, "--prompt", "night", "--in-scene", "--json")
    result = succeed(*words, store=own_run.store).json
    assert result["derived_from"] == own_run.run_id
    assert result["change"]["parameters"]["prompt"] == "night:1"
    again = succeed(*words, store=own_run.store).json
    assert (again["run_id"], again["computed_now"]) == (result["run_id"], {"style": False})
    brightness = []
    for run in (own_run.run_id, result["run_id"]):
        succeed("render", run, *PATH, "--out", tmp_path / run, store=own_run.store)
        brightness.append(seen_image(tmp_path / run / "0002.png", WIDTH_PX, HEIGHT_PX).mean())
    assert brightness[1] < 0.7 * brightness[0]
    listed = succeed("catalog", "list", "runs", "--json", store=own_run.store).json["rows"]
    (row,) = (row for row in listed if row["run_id"] == result["run_id"])
    assert row["derived_from"] == own_run.run_id
    painted = ("--painter", "overlay", "--out", tmp_path / "painted")
    assert "painters know clear days" in refuse(
        "render", result["run_id"], *PATH, *painted, store=own_run.store
    )
    twice = ("--prompt", "night", "--frames", "2:3", "--out", tmp_path / "twice")
    assert "the run is in the style night:1, and styles are put on clear days" in refuse(
        "stylize", result["run_id"], *twice, store=own_run.store
    )
    assert not (tmp_path / "twice").exists()


@pytest.mark.parametrize("wanted", ["colmap", "nerfstudio", "lidar", "lidar-bin"])
def test_what_was_recorded_is_not_exported_of_a_run_in_a_style(own_run, tmp_path, wanted):
    words = ("stylize", own_run.run_id, "--prompt", "night", "--in-scene", "--json")
    styled = succeed(*words, store=own_run.store).json["run_id"]
    words = ("export", styled, "--format", wanted, "--out", tmp_path / "out")
    assert f"was changed (style): export {own_run.run_id}, which it was derived" in refuse(
        *words, store=own_run.store
    )
    assert list(tmp_path.iterdir()) == []


def test_half_a_fog_hides_less_than_a_whole_one(own_run, tmp_path):
    images = []
    for strength in ("0.5", "1"):
        out = tmp_path / strength
        words = ("--prompt", "foggy", "--strength", strength, "--frames", "2:3", "--out", out)
        succeed("stylize", own_run.run_id, *words, store=own_run.store)
        images.append(seen_image(out / "0002.png", WIDTH_PX, HEIGHT_PX))
    clear = seen_image(tmp_path / "1" / "clear" / "0002.png", WIDTH_PX, HEIGHT_PX)
    deviations = [float(np.std(image)) for image in (clear, *images)]
    assert deviations == sorted(deviations, reverse=True)
