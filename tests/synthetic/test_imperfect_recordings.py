"""What a real rig does to a recording, and the truth beside it."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from camera_rows import camera_rows

from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import RigCamera, SyntheticStreet, SyntheticStreetConfig
from lidarpainter_models.synthetic.plan.ego_motion import Pace
from lidarpainter_models.synthetic.sequence import record_street
from lidarpainter_models.synthetic.textures.surfaces import SurfaceSet
from lidarpainter_models.synthetic.world.traffic import StreetActor, draw_person

READOUT_S = 0.03
SMALL = {"seed": 7, "num_frames": 3, "width_px": 96, "height_px": 64}


def with_camera(**changes):
    """The street of a front camera; with a wide lens what is near moves much."""
    camera = RigCamera(name="front_camera", focal_per_width=0.6, **changes)
    return SyntheticStreetConfig(**SMALL, cameras=(camera,), sensor_noise=0.0)


def driven_at(speed_mps, **camera):
    """The street of the seed with another pace of the recording car alone."""
    street = SyntheticStreet(with_camera(**camera))
    street._city = dataclasses.replace(
        street._city, ego=street._city.ego.at_speed(speed_mps, speed_mps)
    )
    return street


def test_every_row_is_read_at_its_own_time():
    fast_street = driven_at(15.0, readout_s=READOUT_S)
    height, timestamp_ns = SMALL["height_px"], fast_street.timestamps_ns[1]
    read = fast_street.render_recorded("front_camera", timestamp_ns).rgb
    for row in (0, 40, height - 1):
        row_ns = timestamp_ns + round(((row + 0.5) / height - 0.5) * READOUT_S * 1e9)
        at_once = fast_street.render(fast_street.camera("front_camera", row_ns), row_ns).rgb
        assert (read[row] - at_once[row]).abs().mean() < 1e-3  # poses of a nanosecond's rounding
    middle = fast_street.render(fast_street.camera("front_camera", timestamp_ns), timestamp_ns)
    assert (read[-1] - middle.rgb[-1]).abs().mean() > 5e-3  # nearest and last


def test_the_car_drives_as_fast_as_asked():
    fast_street = driven_at(15.0)
    start, end = (fast_street.world_from_ego(fast_street.timestamps_ns[i])[:3, 3] for i in (0, -1))
    assert float((end - start).norm()) == pytest.approx(2 * 0.1 * 15.0, rel=0.01)


def test_a_car_that_stands_does_not_move_at_all():
    street = driven_at(0.0)
    first, last = (street.world_from_ego(street.timestamps_ns[i]) for i in (0, -1))
    assert torch.equal(first, last)


def test_a_walker_swings_its_legs_inside_its_box():
    person = draw_person(SurfaceSet(), np.random.default_rng(3))
    meshes, size = person.postures(8)
    reach_m = [np.abs(mesh.corners()).max((0, 1)) for mesh in meshes]
    assert np.max(reach_m, axis=0) == pytest.approx(size / 2)
    length_m = [np.ptp(mesh.corners()[..., 0]) for mesh in meshes]
    assert max(length_m) > 1.15 * min(length_m)
    feet_m = [mesh.corners()[..., 2].min() for mesh in meshes]
    assert np.ptp(feet_m) < 0.02  # one foot is always on the ground


def test_a_walker_is_drawn_in_the_posture_of_the_moment():
    walker = StreetActor(
        actor_id="person",
        category="pedestrian",
        size_m=np.ones(3),
        meshes=draw_person(SurfaceSet(), np.random.default_rng(3)).postures(8)[0],
        start_s_m=0.0,
        d_m=0.0,
        pace=Pace(-1.5, -1.5),
        cycle_m=1.2,
    )
    assert walker.posture(np.array([0.0, 0.1, 0.4, 0.8])).tolist() == [0, 1, 4, 0]


@pytest.mark.parametrize("is_told", [True, False])
def test_the_readout_is_stored_where_it_is_told(tmp_path, is_told):
    config = dataclasses.replace(with_camera(readout_s=READOUT_S), is_readout_told=is_told)
    scene = DrivingScene.open(record_street(SyntheticStreet(config), tmp_path))
    stored = [row["rolling_shutter_s"] for row in camera_rows(scene)]
    assert stored == [READOUT_S if is_told else None] * SMALL["num_frames"]


def test_a_turned_camera_shows_what_lies_to_the_left_of_its_stored_pose(tmp_path):
    turn = math.radians(2)
    street = SyntheticStreet(with_camera(yaw_error_rad=turn))
    scene = DrivingScene.open(record_street(street, tmp_path))
    view = scene.views[1]
    true = street.camera("front_camera", view.timestamp_ns)
    ahead = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    truly, stated = (c.world_from_camera[:3, :3] @ ahead for c in (true, view.camera))
    assert float(torch.linalg.cross(stated, truly)[2]) == pytest.approx(math.sin(turn), rel=1e-3)


def test_a_late_camera_shows_a_later_moment(tmp_path):
    street = SyntheticStreet(with_camera(delay_s=0.1))
    scene = DrivingScene.open(record_street(street, tmp_path))
    now, later = scene.read_image(scene.views[0]), street.timestamps_ns[1]
    shown = street.render(street.camera("front_camera", later), later).rgb
    then = street.timestamps_ns[0]
    stated = street.render(street.camera("front_camera", then), then).rgb
    errors = [float((now.float() / 255 - rgb).abs().mean()) for rgb in (shown, stated)]
    assert errors[0] < 0.5 * errors[1]


def test_gain_drifts_with_time(tmp_path):
    images = []
    for drift in (0.0, -1.0):
        config = with_camera(gain=0.5, gain_drift=drift)
        path = record_street(SyntheticStreet(config), tmp_path / f"{drift}")
        scene = DrivingScene.open(path)
        images.append(scene.read_image(scene.views[2]).float().mean())
    assert float(images[1] / images[0]) == pytest.approx(1 - 0.2, abs=0.01)
