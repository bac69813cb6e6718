"""`edit` from a list of actors to a run of its own, `stylize --in-scene` from a word to one."""

import json

import numpy as np
import pytest
from commands import call, refuse, seen_image, succeed
from tiny_street import HEIGHT_PX, WIDTH_PX

from lidarpainter_models.editing.apply import edited
from tasks.runs import open_run
from tasks.stored import load_observations, load_scene

PATH = ("--trajectory", "recorded", "--frames", "2:3")


@pytest.fixture(scope="module")
def ahead(own_run):
    """Who is listed as the nearest moving car that was seen."""
    listed = succeed("edit", own_run.run_id, "actors", "--json", store=own_run.store).json
    found = [row for row in listed["actors"] if row["is_moving"] and row["num_gaussians"] > 20]
    return found[0]["actor_id"]


def test_one_script_takes_out_moves_puts_in_and_shows(own_run, ahead, tmp_path):
    script = tmp_path / "edits.json"
    places = tmp_path / "places.csv"
    places.write_text("x_m,y_m\n20,1\n40,2\n")
    operations = [
        {"op": "insert", "name": "guest", "source": {"actor": ahead}, "ahead_m": 9},
        {"op": "re-route", "actor": "guest", "trajectory": f"waypoints:{places}"},
        {"op": "remove", "actors": [ahead]},
        {"op": "drive", "trajectory": "lateral:1"},
        {"op": "lamps", "actor": "guest", "state": "brake"},
        {"op": "style", "prompt": "foggy+night:0.5"},
    ]
    script.write_text(json.dumps(operations))
    words = ("edit", own_run.run_id, "--script", script, "--allow-collisions", "--json")
    first = succeed(*words, "--out", tmp_path / "shown", store=own_run.store).json
    assert first["trajectory"] == "lateral:1"
    seen_image(tmp_path / "shown" / "0000.png", WIDTH_PX, HEIGHT_PX)
    run = open_run(own_run.store, first["run_id"])
    scene = load_scene(own_run.store, run.final.gaussians)
    assert scene.style.mix.text == "foggy:1+night:0.5"
    assert [change.actor_id for change in scene.style.lamps] == ["guest"]
    names = [track.actor_id for track in scene.tracks]
    assert "guest" in names
    assert ahead not in names
    views = load_observations(own_run.store, run.final.observations).views
    assert any(bool(view.hidden.any()) for view in views)
    again = succeed(*words, store=own_run.store).json
    assert again["run_id"] == first["run_id"]
    assert not any(again["computed_now"].values())
    places.write_text("x_m,y_m\n20,1\n40,-2\n")  # what a script reads is part of it
    assert succeed(*words, store=own_run.store).json["run_id"] != first["run_id"]


def test_edits_of_an_edited_run_are_added_to_its_list(own_run, ahead):
    store = own_run.store
    first = succeed("edit", own_run.run_id, "scale", ahead, "factor=1.1", "--json", store=store)
    second = succeed("edit", first.json["run_id"], "freeze", "at_s=0.2", "--json", store=store).json
    assert second["derived_from"] == own_run.run_id
    told = second["change"]["parameters"]["operations"]
    assert [one["op"] for one in told] == ["scale", "freeze"]


def actors(store, run):
    return succeed("edit", run, "actors", "--json", store=store).json["actors"]


def test_edits_are_known_once_the_run_is_styled(own_run, ahead):
    store = own_run.store
    parked = [row["actor_id"] for row in actors(store, own_run.run_id) if not row["is_moving"]]
    removed = succeed("edit", own_run.run_id, "remove", parked[0], "--json", store=store).json
    words = ("stylize", removed["run_id"], "--prompt", "foggy:0.5", "--visibility", "80")
    styled = succeed(*words, "--in-scene", "--json", store=store).json["run_id"]
    left = [row["actor_id"] for row in actors(store, styled)]
    assert parked[0] not in left
    assert set(parked[1:]) < set(left)
    refused = call("assets", "publish", styled, store=store)
    assert refused.code == 2
    assert f"was changed (edit), expected a recorded or styled one: publish {own_run.run_id}" in (
        refused.err
    )
    again = succeed("edit", styled, "scale", ahead, "factor=1.3", "--json", store=store).json
    assert again["derived_from"] == own_run.run_id
    told = again["change"]["parameters"]["operations"]
    assert [one["op"] for one in told] == ["remove", "style", "scale"]
    assert told[1] == {"op": "style", "prompt": "foggy:0.5", "visibility_m": 80.0}
    assert again["summary"]["style"] == "foggy:0.5"


def test_a_style_and_a_drive_can_be_said_as_words(own_run):
    words = ("style", "prompt=foggy", "strength=0.5", "seed=3", "visibility_m=80")
    styled = succeed("edit", own_run.run_id, *words, "--json", store=own_run.store).json
    (told,) = styled["change"]["parameters"]["operations"]
    assert told == {
        "op": "style",
        "prompt": "foggy",
        "strength": 0.5,
        "seed": 3,
        "visibility_m": 80.0,
    }
    words = ("edit", styled["run_id"], "drive", "trajectory=lateral:1", "--json")
    assert succeed(*words, store=own_run.store).json["trajectory"] == "lateral:1"


def test_edits_are_done_once_for_check_images_and_scene(own_run, ahead, monkeypatch):
    done = []
    monkeypatch.setattr(
        "tasks.editing.edit.edited", lambda *args: done.append(args) or edited(*args)
    )
    succeed("edit", own_run.run_id, "scale", ahead, "factor=1.2", store=own_run.store)
    assert len(done) == 1


def test_runs_of_places_that_nothing_ties_are_not_joined(own_run, monkeypatch):
    names = iter(("here", "there"))
    monkeypatch.setattr("tasks.editing.edit.global_frame_of", lambda _scene: next(names))
    assert "nothing ties the frame of synthetic/street-0005 to that of" in refuse(
        "edit", own_run.run_id, "join", own_run.run_id, store=own_run.store
    )


def test_a_run_that_is_joined_to_itself_stays_as_large_as_it_is(own_run, monkeypatch):
    monkeypatch.setattr(
        "lidarpainter_models.editing.scene_merging.FINER", 0.5
    )  # it looked well enough
    told = succeed("edit", own_run.run_id, "join", own_run.run_id, "--json", store=own_run.store)
    joined = open_run(own_run.store, told.json["run_id"])
    assert [one["op"] for one in told.json["change"]["parameters"]["operations"]] == ["join"]
    sizes = [
        len(load_scene(own_run.store, run.final.gaussians).gaussians)
        for run in (open_run(own_run.store, own_run.run_id), joined)
    ]
    assert sizes[1] == pytest.approx(sizes[0], rel=0.05)


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
