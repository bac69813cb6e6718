"""Where the cameras of a rig stand in one image."""

import math

import pytest
import torch

from lidarpainter_models.export.view_files import rig_rows, tiled

AHEAD = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # right, down and forward in the car


def camera(azimuth_deg, left_m=0.0):
    """ego_from_camera of a level camera that looks so far to the left."""
    pose = torch.eye(4, dtype=torch.float64)
    cos, sin = (turn(math.radians(azimuth_deg)) for turn in (math.cos, math.sin))
    pose[:3, :3] = (torch.tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ AHEAD).double()
    pose[1, 3] = left_m
    return pose


@pytest.mark.parametrize(
    ("azimuths_deg", "rows"),
    [
        ((0, 55, -55, 110, -110, 180), ((1, 0, 2), (3, 5, 4))),  # nuScenes, PandaSet
        ((0, 45, -45, 90, -90), ((1, 0, 2), (3, 4))),  # Waymo
        ((0, 45, -45, 99, -99, 153, -153), ((1, 0, 2), (3, 5, 6, 4))),  # Argoverse 2
        ((-179, 179), ((1, 0),)),
        ((12,), ((0,),)),
    ],
)
def test_what_is_left_in_the_car_is_left_in_the_image(azimuths_deg, rows):
    assert rig_rows(torch.stack([camera(angle) for angle in azimuths_deg])) == rows


def test_a_stereo_pair_stands_as_its_lenses_do():
    pair = torch.stack([camera(0.1, left_m=-0.3), camera(-0.1, left_m=0.2)])
    assert rig_rows(pair) == ((1, 0),)


def test_cameras_of_other_sizes_are_shown_as_high_as_the_least_high():
    sizes = [(10, 20), (20, 20), (10, 6)]
    images = [torch.full((*size, 3), 0.2 * (n + 1)) for n, size in enumerate(sizes)]
    whole = tiled(images, ((0, 1), (2,)))
    assert whole.shape == (20, 30, 3)
    torch.testing.assert_close(whole[:10, :20], images[0])
    torch.testing.assert_close(whole[:10, 20:], torch.full((10, 10, 3), 0.4))
    torch.testing.assert_close(whole[10:, 12:18], images[2])  # in the middle, black beside it
    assert not whole[10:, :12].any()
    assert not whole[10:, 18:].any()
