"""What is said of an actor's sides, directions and occlusion, against cameras placed by hand."""

import math

import pytest
import torch

from lidarpainter_models.assets.sightings import REACH_RAD, SIDES, Sighting, box_view
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.trajectory_parts import headed

SIZE_M = torch.tensor([4.0, 2.0, 1.5])
WIDTH_PX, HEIGHT_PX = 160, 120
CLEAR_M = torch.zeros(HEIGHT_PX, WIDTH_PX)


def camera_from(azimuth_deg, *, distance_m=12.0, up_m=0.8):
    """Looks at the middle of a box at the origin, from the azimuth in its frame."""
    azimuth = math.radians(azimuth_deg)
    place = torch.tensor([math.cos(azimuth), math.sin(azimuth), 0.0]) * distance_m
    place[2] = up_m
    forward = -place / place.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0]))
    right = right / right.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
    pose[:3, 3] = place
    return Camera.centred(pose, 200.0, width_px=WIDTH_PX, height_px=HEIGHT_PX)


def sighting(cameras, depth_m=None):
    """A box at the origin in views of nothing else, or of surfaces at some depth."""
    found = Sighting()
    for camera in cameras:
        view = box_view(camera, CLEAR_M if depth_m is None else depth_m, torch.eye(4), SIZE_M)
        assert view is not None
        found.add_look(view, camera.fx_px)
    return found


@pytest.mark.parametrize(
    ("azimuth_deg", "up_m", "sides"),
    [
        (0, 0.8, ["front"]),
        (180, 0.8, ["rear"]),
        (90, 0.8, ["left"]),
        (-90, 0.8, ["right"]),
        (45, 0.8, ["front", "left"]),
        (-135, 0.8, ["rear", "right"]),
        (175, 0.8, ["rear"]),  # the left one is there, too slanting to show anything
        (135, 8.0, ["rear", "left", "top"]),
    ],
)
def test_a_camera_sees_the_sides_that_face_it(azimuth_deg, up_m, sides):
    assert sighting([camera_from(azimuth_deg, up_m=up_m)]).sides == sides


def test_sides_of_several_views_add_up():
    found = sighting([camera_from(azimuth) for azimuth in (170, 120, 60)])
    assert found.sides == ["front", "rear", "left"]
    assert found.score > sighting([camera_from(170)]).score


def test_one_direction_covers_its_share_of_the_half_sphere():
    """A cap of 20 degrees about the zenith is 1 - cos 20 of it; at the horizon half of one."""
    cap = 1 - math.cos(REACH_RAD)
    above = sighting([camera_from(10, distance_m=1.0, up_m=60.0)])
    assert above.coverage == pytest.approx(cap, abs=0.003)
    beside = sighting([camera_from(10, up_m=0.0)])
    assert beside.coverage == pytest.approx(cap / 2, abs=0.003)
    around = sighting([camera_from(azimuth, up_m=0.0) for azimuth in range(0, 360, 10)])
    assert around.coverage == pytest.approx(math.sin(REACH_RAD), abs=0.01)


def test_a_wall_before_a_box_hides_it():
    """A wall over the left half of the image, 5 m away; the box is 12 m away."""
    wall_m = torch.zeros(HEIGHT_PX, WIDTH_PX)
    wall_m[:, : WIDTH_PX // 2] = 5.0
    found = sighting([camera_from(180)], wall_m)
    assert found.occlusion == pytest.approx(0.5, abs=0.02)
    behind = sighting([camera_from(180)], torch.full((HEIGHT_PX, WIDTH_PX), 20.0))
    assert behind.occlusion == 0
    hidden = sighting([camera_from(180)], torch.full((HEIGHT_PX, WIDTH_PX), 5.0))
    assert (hidden.sides, hidden.near_looks, hidden.coverage, hidden.score) == ([], [], 0, 0)


def test_pixels_and_entry_points_are_those_of_the_projected_box():
    """Straight behind, a box 2 m wide and 1.5 m high shows its rear, 10 m away, at 200 px."""
    view = box_view(camera_from(180, up_m=0.0), CLEAR_M, torch.eye(4), SIZE_M)
    assert set(view.side.tolist()) == {SIDES.index("rear")}
    assert len(view.row) == (2.0 / 10 * 200) * (1.5 / 10 * 200)
    assert view.entry_box[:, 0].tolist() == pytest.approx([-1.0] * len(view.row), abs=1e-5)
    assert view.camera_box.tolist() == pytest.approx([-12, 0, 0], abs=1e-5)
    left = view.column < WIDTH_PX / 2
    assert bool((view.entry_box[left, 1] > 0).all())  # seen from behind, its left is ours


def test_the_frame_of_the_box_decides_and_not_the_world():
    pose = headed(torch.tensor([[3.0, -2.0, 0.5]]).double(), torch.tensor([1.0]).double())[0]
    camera = camera_from(60)
    view = box_view(camera.at(pose @ camera.world_from_camera), CLEAR_M, pose, SIZE_M)
    alone = box_view(camera, CLEAR_M, torch.eye(4), SIZE_M)
    assert torch.equal(view.side, alone.side)
    assert torch.allclose(view.camera_box, alone.camera_box, atol=1e-5)


def test_who_is_behind_the_camera_is_not_seen():
    camera = camera_from(0)
    behind = torch.eye(4)
    behind[0, 3] = 30.0
    assert box_view(camera, CLEAR_M, behind, SIZE_M) is None


def test_errors_count_where_nothing_stands_before_the_box():
    wall_m = torch.zeros(HEIGHT_PX, WIDTH_PX)
    wall_m[:, : WIDTH_PX // 2] = 5.0
    view = box_view(camera_from(180), wall_m, torch.eye(4), SIZE_M)
    error = torch.where(wall_m > 0, 1.0, 0.01)  # wrong on the wall, 20 dB beside it
    found = Sighting()
    found.add_error(view, error, torch.full_like(error, 0.1), torch.full_like(error, 0.2))
    assert found.psnr_db == pytest.approx(20.0, abs=1e-4)
    assert found.sharpness == pytest.approx(0.5, abs=1e-6)
