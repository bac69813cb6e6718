"""Boxes cover the pixels whose rays meet them, also where they reach behind the camera."""

import pytest
import torch

from lidarpainter_models.geometry.box_masks import NEAR_M, project_boxes
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import (
    invert_rigid,
    rigid_from_rotation,
    rotation_from_vector,
    transform_points,
)

SIZE_M = torch.tensor([4.0, 1.8, 1.5])
CAMERA = Camera.centred(torch.eye(4, dtype=torch.float64), 60.0, width_px=96, height_px=64)


def box_at(x_m, y_m, z_m, yaw_rad=0.3):
    turn = rotation_from_vector(torch.tensor([0.1, yaw_rad, 0.2], dtype=torch.float64))
    return rigid_from_rotation(turn, torch.tensor([x_m, y_m, z_m], dtype=torch.float64))


def covered(world_from_box):
    boxes, present = world_from_box[None], torch.tensor([True])
    return project_boxes(CAMERA, boxes, [SIZE_M], present, margin=1.0)


def met_by_rays(world_from_box):
    """Pixels whose rays meet the box beyond the near plane, by the slabs of its sides."""
    box_from_world = invert_rigid(world_from_box)
    start = box_from_world[:3, 3]
    along = CAMERA.pixel_directions().double() @ box_from_world[:3, :3].T
    sides = torch.stack([(sign * SIZE_M.double() / 2 - start) / along for sign in (-1, 1)])
    enters, leaves = sides.amin(0).amax(-1), sides.amax(0).amin(-1)
    return leaves > enters.clamp(min=NEAR_M)


@pytest.mark.parametrize(
    "place", [(0, 0, 9, 0.3), (3, 1, 6, 1.2), (2, 0, 1, 1.5), (-1.5, 0.6, 0.4, 1.4), (0, 0, 0.4, 0)]
)
def test_a_box_covers_the_pixels_whose_rays_meet_it(place):
    mask, truth = covered(box_at(*place)), met_by_rays(box_at(*place))
    assert 0.01 < float(truth.float().mean()) <= 1
    # the outline is rounded to whole pixels, so only pixels beside it may differ
    inside = torch.nn.functional.avg_pool2d(truth.float()[None], 5, 1, 2, count_include_pad=False)
    assert mask[inside[0] == 1].all()
    assert not mask[inside[0] == 0].any()


def test_a_box_behind_the_near_plane_covers_nothing():
    assert not covered(box_at(0, 0, -5)).any()
    corners_z = transform_points(box_at(0, 0, -5), SIZE_M.double()[None] / 2)[:, 2]
    assert float(corners_z.max()) < NEAR_M


def test_an_absent_box_covers_nothing():
    absent = torch.tensor([False])
    assert not project_boxes(CAMERA, box_at(0, 0, 9)[None], [SIZE_M], absent).any()
