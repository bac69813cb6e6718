"""Gaussians where each is when its own pixel is read."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import FRAME_NS, camera_at, car_track, round_gaussians

from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.drawing import camera_from_body
from lidarpainter_models.gaussians.model.rolling_shutter import as_read, bodies_while_read
from lidarpainter_models.geometry.cameras import Shutter

MIDDLE_NS = FRAME_NS
ACTORS = Actors.uncorrected([car_track(3)], torch.arange(3) * FRAME_NS)


def rolling(across_s, *, turn=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0)):
    twist = torch.tensor([*turn, *velocity], dtype=torch.float64)
    return replace(camera_at(0.0), shutter=Shutter(across_s=across_s, twist_per_s=twist))


def read_by(camera, gaussians):
    bodies = camera_from_body(camera.world_from_camera, *ACTORS.recorded_poses(MIDDLE_NS))
    return as_read(gaussians, bodies, camera, ACTORS, MIDDLE_NS)


def wall(body=0):
    means = torch.tensor([[6.0, 2.0, -1.0], [8.0, 0.0, 1.0], [7.0, -3.0, 4.0]])
    return round_gaussians(means, torch.rand(3, 3), sigma_m=0.1, body=body)


def test_a_camera_that_reads_at_once_changes_nothing():
    gaussians = wall()
    assert read_by(rolling((0.0, 0.0), velocity=(0.0, 0.0, 15.0)), gaussians) is gaussians


@pytest.mark.parametrize("across_s", [(0.0, 0.03), (0.0, -0.03), (0.02, 0.0)])
def test_what_stands_is_drawn_where_the_camera_projects_it(across_s):
    camera = rolling(across_s, turn=(0.02, 0.3, -0.1), velocity=(0.5, 0.0, 15.0))
    gaussians = wall()
    at_once = replace(camera, shutter=None)
    expected, _ = camera.project(gaussians.means.double())
    found, _ = at_once.project(read_by(camera, gaussians).means.double())
    before, _ = at_once.project(gaussians.means.double())
    assert torch.allclose(found, expected, atol=0.02)  # the rotation's second order
    assert float((before - expected).abs().max()) > 0.3


@pytest.mark.parametrize("across_s", [(0.0, 0.03), (0.0, -0.03)])
def test_the_near_road_is_stretched_as_its_rows_are_read(across_s):
    camera = rolling(across_s, velocity=(0.0, 0.0, 15.0))
    at_once = replace(camera, shutter=None)
    road = round_gaussians(torch.tensor([[3.5, 0.5, -0.4]]), torch.rand(1, 3), sigma_m=0.2)
    read = read_by(camera, road)

    def length_px(seen_by, gaussians):
        along = gaussians.scale_m[:, :1] * torch.tensor([[1.0, 0.0, 0.0]])
        (far, _), (near, _) = (
            seen_by.project((gaussians.means + end).double()) for end in (along, -along)
        )
        return float((near - far).norm())

    whole = replace(read, log_scale=road.log_scale)
    assert length_px(at_once, read) == pytest.approx(length_px(camera, road), rel=0.01)
    assert length_px(at_once, whole) != pytest.approx(length_px(camera, road), rel=0.03)


def test_an_actor_is_where_it_drove_until_its_row_was_read():
    camera = rolling((0.0, 0.03))
    in_box = torch.tensor([[0.3, 0.2, -0.4]])
    gaussians = round_gaussians(in_box, torch.rand(1, 3), sigma_m=0.1, body=1)
    moved = read_by(camera, gaussians).means - in_box
    pose = ACTORS.recorded_poses(MIDDLE_NS)[0][0]
    pixels_uv, _ = camera.project((pose[:3, :3] @ in_box[0].double() + pose[:3, 3])[None])
    driven_m = 10.0 * float(camera.read_s(pixels_uv))  # 1 m a frame of 0.1 s, along its x axis
    assert float(moved[0, 0]) == pytest.approx(driven_m, rel=0.01)
    assert float(moved[0, 1:].abs().max()) < 1e-5


def test_bodies_are_known_from_the_first_pixel_to_the_last():
    """From where they stand in the middle, which may be corrected: here half a metre ahead."""
    camera = rolling((0.0, -0.03), velocity=(0.0, 0.0, 15.0))
    poses, present = ACTORS.recorded_poses(MIDDLE_NS)
    corrected = poses.clone()
    corrected[:, 0, 3] += 0.5
    bodies = camera_from_body(camera.world_from_camera, corrected, present)
    first, last = bodies_while_read(bodies, camera, ACTORS, MIDDLE_NS)
    assert float(first[0, 2, 3] - last[0, 2, 3]) == pytest.approx(15.0 * 0.03, rel=1e-5)
    car = torch.stack([first[1], last[1]])[:, :3, 3]
    assert float(car[0, 0] - car[1, 0]) == pytest.approx(0.3, abs=0.01)  # 10 m/s to the left
    assert torch.allclose(car.mean(dim=0), bodies[1, :3, 3], atol=1e-5)
    at_once = camera.at(camera.world_from_camera)
    assert bodies_while_read(bodies, at_once, ACTORS, MIDDLE_NS) == []


def test_gradients_reach_centres_and_sizes():
    gaussians = wall().as_leaves()
    read = read_by(rolling((0.0, 0.03), velocity=(0.0, 0.0, 15.0)), gaussians)
    (read.means.sum() + read.log_scale.sum()).backward()
    assert float(gaussians.means.grad.abs().min()) > 0.5
    assert float(gaussians.log_scale.grad.abs().min()) > 0.5
