"""A finished run, shown where nobody drove: as it is, painted, and in another weather."""

import json
from dataclasses import replace

import cv2
import pytest

from lidarpainter_models.conditioning.settings import SequenceConfig
from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.evaluation.view_confidence import BUNDLED, PROMISED
from lidarpainter_models.export.styled_views import StyleRequest
from lidarpainter_models.export.view_requests import ViewRequest
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from lidarpainter_models.weather.mix import StyleMix
from tasks.views.render import render, stylize


@pytest.mark.parametrize("is_painted", [False, True])
def test_a_run_is_rendered_where_nobody_drove(viewed, tmp_path, is_painted):
    request = ViewRequest(
        trajectory=parse_trajectory("lane-change:2+up:0.5"),
        frames=slice(1, 3),
        is_painted=is_painted,
    )
    made = render(viewed, request, tmp_path)
    assert made["num_images"] == 2
    described = json.loads((tmp_path / "trajectory.json").read_text())
    assert [row["file"] for row in described["images"]] == ["0001.png", "0002.png"]
    first, last = (row["world_from_camera"] for row in described["images"])
    assert last[7] - first[7] == pytest.approx(2.0, abs=0.2)  # y is to the left
    at_home, aside = (row["predicted_db"] for row in described["images"])
    assert at_home > aside
    assert all(0 <= row["confidence"] <= 1 for row in described["images"])


def test_what_is_said_of_frames_is_by_the_calibration_of_their_run(viewed, tmp_path):
    request = ViewRequest(trajectory=parse_trajectory("recorded"), frames=slice(1, 2))
    said = []
    for calibration in (BUNDLED, replace(BUNDLED, intercept_db=BUNDLED.intercept_db + 10)):
        render(replace(viewed, calibration=calibration), request, tmp_path)
        described = json.loads((tmp_path / "trajectory.json").read_text())
        said.append(described["images"][0])
    first, second = said
    assert second["predicted_db"] == pytest.approx(first["predicted_db"] + 10)
    assert second["confidence"] > first["confidence"]


@pytest.mark.parametrize("images", ["rendered", "recorded"])
def test_a_run_is_shown_in_fog_beside_the_clear_images(viewed, tmp_path, images):
    view = ViewRequest(trajectory=parse_trajectory("recorded"), frames=slice(1, 3))
    style = StyleRequest(mix=StyleMix.parse("foggy"), images=images)
    made = stylize(viewed, view, style, tmp_path / "a")
    assert made["num_images"] == 2
    assert 0.5 < made["edge_f1"] <= 1
    described = json.loads((tmp_path / "a" / "trajectory.json").read_text())
    assert (described["prompt"], len(described["images"])) == ("foggy:1", 2)
    foggy, clear = (
        cv2.imread(str(tmp_path / "a" / name)) for name in ("0001.png", "clear/0001.png")
    )
    assert float(foggy.std()) < float(clear.std())
    stylize(viewed, view, style, tmp_path / "b")
    again = (tmp_path / "b" / "0001.png").read_bytes()
    assert again == (tmp_path / "a" / "0001.png").read_bytes()


def test_a_painter_is_asked_for_the_prompt(viewed, tmp_path):
    request = ViewRequest(
        trajectory=parse_trajectory("recorded"), frames=slice(1, 2), is_painted=True, prompt="foggy"
    )
    with pytest.raises(ConfigError, match="knows no prompt 'foggy', only: clear"):
        render(replace(viewed, run=replace(viewed.run, painter="nano")), request, tmp_path)
    with pytest.raises(ConfigError, match="prompt 'foggy' needs a painter"):
        replace(request, is_painted=False)


def test_a_path_is_painted_with_the_previous_image_mixed_in(viewed, tmp_path):
    plain = ViewRequest(
        trajectory=parse_trajectory("lateral:1"), frames=slice(0, 3), is_painted=True
    )
    mixed = replace(plain, sequence=SequenceConfig(previous="mixed"))
    for name, request in (("plain", plain), ("mixed", mixed)):
        render(viewed, request, tmp_path / name)
    same = [
        (tmp_path / "plain" / name).read_bytes() == (tmp_path / "mixed" / name).read_bytes()
        for name in ("0000.png", "0001.png", "0002.png")
    ]
    assert same == [True, False, False]
    with pytest.raises(ConfigError, match="--previous needs a painter"):
        replace(mixed, is_painted=False)


def test_recorded_images_exist_only_where_somebody_stood():
    view = ViewRequest(trajectory=parse_trajectory("lateral:2"))
    with pytest.raises(ConfigError, match="on the recorded trajectory"):
        StyleRequest(mix=StyleMix.parse("foggy"), images="recorded").check(view)


def test_an_unknown_camera_is_named_before_anything_is_drawn(viewed, tmp_path):
    request = ViewRequest(trajectory=parse_trajectory("recorded"), camera="back")
    with pytest.raises(SceneError, match="has no camera 'back', it has front"):
        render(viewed, request, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_path_into_a_wall_is_refused_unless_that_is_wanted(viewed, tmp_path):
    places = tmp_path / "places.csv"
    places.write_text("x_m,y_m,yaw_deg\n0,0,0\n20,-4,0\n")  # the wall is at 20 m
    request = ViewRequest(trajectory=parse_trajectory(f"waypoints:{places}"))
    out = tmp_path / "out"
    with pytest.raises(ConfigError, match=r"leads the camera into a wall: \d+ LiDAR points from"):
        render(viewed, request, out)
    assert not out.exists()
    made = render(viewed, replace(request, allows_collisions=True), out)
    assert made["collisions"][0]["obstacle"] == "points"
    described = json.loads((out / "trajectory.json").read_text())
    assert described["collisions"] == made["collisions"]
    promised = [row for row in described["images"] if row["confidence"] >= PROMISED]
    assert made["num_trusted"] == len(promised)
