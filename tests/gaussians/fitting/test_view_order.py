"""Cameras of a frame that look apart are looked at at once."""

import math
from dataclasses import replace

import numba
import pytest
import torch
from gaussian_world import (
    FRAME_NS,
    HEIGHT_PX,
    WIDTH_PX,
    camera_at,
    map_points,
    observe,
    round_gaussians,
    scene_of,
    turned_camera,
)

from lidarpainter_models.gaussians.fitting.checkpoint import CheckpointFolder
from lidarpainter_models.gaussians.fitting.config import FitConfig, RefinementConfig
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.gaussians.fitting.images import full_image
from lidarpainter_models.gaussians.fitting.settings import DensificationConfig
from lidarpainter_models.gaussians.fitting.state import FitState
from lidarpainter_models.gaussians.fitting.step import Look, fit_step
from lidarpainter_models.gaussians.fitting.view_order import ViewOrder, look_apart
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.gaussians.model.corrections import CameraCorrections, ExposureCorrections
from lidarpainter_models.gaussians.model.stored_scene import scene_to_arrays
from lidarpainter_models.lidar.lidar_map import LidarMap
from lidarpainter_models.observations.views import SceneObservations

CONFIG = FitConfig(
    steps=30,
    half_resolution=0.25,
    initialisation=InitialisationConfig(num_gaussians=700, street_voxel_m=0.2),
    densification=DensificationConfig(budget=900, start=0.2, stop=0.8, every=8),
    refinement=RefinementConfig(start_step=5),
    log_every=7,
)


def between_walls():
    """A scene between two walls, seen by a front and a rear camera in each of four frames."""
    generator = torch.Generator().manual_seed(3)
    y, z = torch.meshgrid(torch.linspace(-6, 6, 40), torch.linspace(-4, 3, 24), indexing="ij")
    ahead_m = torch.stack([8.0 + 0.4 * torch.rand(y.shape, generator=generator), y, z], dim=-1)
    ahead_m = ahead_m.flatten(0, 1)
    wall_m = torch.cat([ahead_m, ahead_m * torch.tensor([-1.0, 1.0, 1.0])])
    wall_rgb = torch.rand(len(wall_m), 3, generator=generator)
    front = [camera_at(0.3 * frame) for frame in range(4)]
    back = turned_camera(math.pi).world_from_camera[:3, :3]
    rear = []
    for camera in front:
        pose = camera.world_from_camera.clone()
        pose[:3, :3] = back
        rear.append(camera.at(pose))
    scene = scene_of(round_gaussians(wall_m, wall_rgb, sigma_m=0.17), [*front, *rear])
    points = map_points(wall_m, wall_rgb)
    views = [
        replace(view, key=(place % 4, name), timestamp_ns=place % 4 * FRAME_NS)
        for place, (view, name) in enumerate(
            zip(
                observe(scene, [*front, *rear], points, points).views,
                ["front"] * 4 + ["rear"] * 4,
                strict=True,
            )
        )
    ]
    lidar_map = LidarMap(street=points, actors={})
    observations = SceneObservations(views=tuple(views), lidar_map=lidar_map, tracks=())
    cameras = CameraCorrections.none(
        [view.key for view in views],
        torch.tensor([view.timestamp_ns for view in views]),
        torch.stack([view.camera.world_from_camera for view in views]),
    )
    exposure = ExposureCorrections.none(["front", "rear"], [0, 0])
    return replace(scene, cameras=cameras, exposure=exposure), observations


@pytest.fixture(scope="module")
def walls():
    return between_walls()


def order_of(groups, frames_and_yaws):
    view = between_walls()[1].views[0]
    views = [
        replace(view, key=(frame, str(yaw)), camera=turned_camera(math.radians(yaw)))
        for frame, yaw in frames_and_yaws
    ]
    return ViewOrder.of(groups, views)


def test_cones_that_meet_do_not_look_apart():
    half_deg = math.degrees(math.atan(math.hypot(32, 24) / (0.8 * 64)))
    first = turned_camera(0.0)
    assert not look_apart(first, turned_camera(math.radians(2 * half_deg - 1)))
    assert look_apart(first, turned_camera(math.radians(2 * half_deg + 1)))
    assert look_apart(first, turned_camera(math.pi))


def test_every_group_has_its_turn_and_two_at_once_are_of_one_frame_and_look_apart():
    rig = [(frame, yaw) for frame in range(5) for yaw in (0, 60, 120, 180, 240, 300)]
    order = order_of(tuple((number,) for number in range(30)), rig)
    generator, waiting = torch.Generator().manual_seed(0), []
    for _ in range(4):
        drawn = []
        while not drawn or waiting:
            drawn.append(order.next_rows(waiting, generator, at_most=2))
        assert sorted(row for rows in drawn for row in rows) == list(range(30))
        pairs = [rows for rows in drawn if len(rows) == 2]
        assert len(pairs) >= 10
        for first, second in pairs:
            assert rig[first][0] == rig[second][0]
            assert (rig[first][1] - rig[second][1]) % 360 in (120, 180, 240)


def test_one_at_a_time_where_no_more_are_allowed():
    order = order_of(((0, 1), (2,)), [(0, 0), (1, 0), (0, 180)])
    generator, waiting = torch.Generator().manual_seed(0), []
    rows = [order.next_rows(waiting, generator, at_most=1) for _ in range(40)]
    assert {len(one) for one in rows} == {1}
    assert {one[0] for one in rows} == {0, 1, 2}


def test_two_at_once_are_two_steps_one_after_the_other(walls):
    """The first of a fit, where nothing moves on by itself yet: bit for bit."""
    scene, observations = walls
    looks = [Look(row, full_image(observations.views[row])) for row in (1, 5)]
    config = replace(CONFIG, refinement=RefinementConfig(start_step=100))
    at_once, in_turn = (FitState.begin(scene, config, WIDTH_PX * HEIGHT_PX) for _ in range(2))
    told = fit_step(at_once, looks, None, config, None)
    for look, one in zip(looks, told, strict=True):
        assert torch.equal(fit_step(in_turn, [look], None, config, None)[0], one)
        in_turn.step += 1
    after, expected = (state.caught_up() for state in (at_once, in_turn))
    moved = after.gaussians.means != scene.gaussians.means
    assert moved[: len(moved) // 2].any()
    assert moved[len(moved) // 2 :].any()
    arrays, others = scene_to_arrays(after)[0], scene_to_arrays(expected)[0]
    for name, value in arrays.items():
        assert torch.equal(value, others[name]), name
    assert torch.equal(at_once.tally.visits, in_turn.tally.visits)


def test_a_fit_of_a_rig_is_the_same_on_any_number_of_threads(walls):
    threads = numba.get_num_threads()
    found = []
    try:
        for count in (1, threads):
            numba.set_num_threads(count)
            found.append(scene_to_arrays(fit_gaussians(walls[1], CONFIG).scene)[0])
    finally:
        numba.set_num_threads(threads)
    for name, value in found[0].items():
        assert torch.equal(value, found[1][name]), name


def test_a_fit_of_a_rig_is_taken_up_bit_for_bit(walls, tmp_path):
    def stop(done, _total, _entry):
        if done > 12:
            raise InterruptedError

    folder = CheckpointFolder(path=tmp_path, every_steps=5, every_seconds=None)
    with pytest.raises(InterruptedError):
        fit_gaussians(walls[1], CONFIG, checkpoints=folder, progress=stop)
    resumed = fit_gaussians(walls[1], CONFIG, checkpoints=folder)
    undisturbed = fit_gaussians(walls[1], CONFIG)
    assert resumed.history[-1]["step"] == CONFIG.steps
    assert [e["step"] for e in resumed.history] == [e["step"] for e in undisturbed.history]
    for name, value in scene_to_arrays(resumed.scene)[0].items():
        assert torch.equal(value, scene_to_arrays(undisturbed.scene)[0][name]), name
