import pytest
import torch

from lidarpainter_models.conditioning.warping import WarpTarget, warped_references
from lidarpainter_models.lidar.points_on_actors import BACKGROUND, MovingBoxes

SECOND_NS = 1_000_000_000


def warp(target, timestamp_ns, depth_m, alpha, source, tracks=()):
    wanted = WarpTarget.of_render(target, timestamp_ns, depth_m, alpha)
    return warped_references(wanted, [source], MovingBoxes(tracks), count=1)


def warp_one(target, boards, source, draw, tracks=(), *, timestamp_ns=0):
    truth, depth_m = draw(target, boards)
    rgb, valid = warp(target, timestamp_ns, depth_m, (depth_m > 0).float(), source, tracks)
    return truth, rgb[0], valid[0]


@pytest.mark.parametrize(("x_m", "y_m", "yaw_rad"), [(0, 0, 0), (1.5, 0.7, 0.0), (0, -1, 0.1)])
def test_a_plane_is_carried_to_another_view(camera_at, board, draw, source_of, x_m, y_m, yaw_rad):
    boards = [board(10.0)]
    source = source_of(camera_at(), boards)
    truth, rgb, valid = warp_one(camera_at(x_m, y_m, yaw_rad=yaw_rad), boards, source, draw)
    assert valid.float().mean() > 0.7
    # bilinear sampling: curvature of the texture times (0.17 m per pixel)^2 / 8
    assert (rgb - truth)[valid].abs().max() < 3e-3
    assert (rgb[~valid] == 0).all()


def test_only_what_falls_into_the_source_is_valid(camera_at, board, draw, source_of):
    boards = [board(10.0)]
    _, _, valid = warp_one(camera_at(0, -3.0), boards, source_of(camera_at(), boards), draw)
    # 3 m to the right at 10 m and 60 px focal length: 18 px on the right are new
    assert valid[:, :46].all()
    assert not valid[:, 46:].any()


def test_what_an_occluder_hid_from_the_source_is_invalid(camera_at, board, draw, source_of):
    boards = [board(20.0), board(5.0, left_m=0.6, right_m=-0.6, tint=0.15)]
    source = source_of(camera_at(), boards)
    truth, rgb, valid = warp_one(camera_at(0, 1.0), boards, source, draw)
    row = valid[24]
    # seen from 1 m to the left the board stands at 36.8..51.2 px, what it hid at 27.8..36.8 px
    assert not row[29:36].any()
    assert row[4:26].all()
    assert row[38:50].all()
    assert row[53:62].all()
    assert (rgb - truth)[valid].abs().max() < 0.02


def test_a_surface_at_a_grazing_angle_passes_the_depth_test(camera_at, source_of):
    target, source_camera = camera_at(0, 0), camera_at(-0.5, 0.3)
    image = source_of(source_camera, [])

    def ground_depth(camera):
        down = camera.pixel_directions()[..., 1]
        return torch.where(down > 0.02, 1.5 / down.clamp(min=1e-6), 0.0)

    source = type(image)(
        **{**vars(image), "depth_m": ground_depth(source_camera), "alpha": torch.ones(48, 64)}
    )
    depth_m = ground_depth(target)
    _, valid = warp(target, 0, depth_m, torch.ones(48, 64), source)
    # the row at 34 m and those nearer: there one row already is 40 % of the depth
    assert valid[0, 27:, 4:60].all()


def test_sky_is_warped_at_infinity(camera_at, board, draw, source_of):
    boards = [board(15.0, top_m=2.0)]
    source = source_of(camera_at(), boards)
    truth, rgb, valid = warp_one(camera_at(0, 4.0), boards, source, draw)
    sky = truth[10]
    assert valid[10].all()
    assert (rgb[10] - sky).abs().max() < 1e-3


def test_sky_hidden_in_the_source_is_invalid(camera_at, board, draw, source_of):
    boards = [board(5.0, left_m=0.5, right_m=-0.5)]
    truth, rgb, valid = warp_one(camera_at(0, 3.0), boards, source_of(camera_at(), boards), draw)
    assert not valid[24, 27:37].any()
    assert (rgb - truth)[valid].abs().max() < 0.02


def test_a_hole_that_is_no_sky_stays_unknown(camera_at, source_of):
    source = source_of(camera_at(), [])
    _, valid = warp(camera_at(), 0, torch.zeros(48, 64), torch.full((48, 64), 0.9), source)
    assert not valid.any()


def test_an_actor_is_carried_by_its_box(camera_at, board, draw, source_of, moving_track):
    then, now = 0, SECOND_NS
    track = moving_track((10.0, 2.0, 1.0), (10.0, -1.0, 1.0), size_m=(1.0, 2.0, 2.0))

    def boards(y_m):
        car = board(10.0, left_m=y_m + 1, right_m=y_m - 1, top_m=2.0, tint=0.15)
        return [board(25.0), car]

    source = source_of(camera_at(), boards(2.0), timestamp_ns=then)
    target = camera_at()
    truth, depth_m = draw(target, boards(-1.0))
    rgb, valid = warp(target, now, depth_m, torch.ones(48, 64), source, [track])
    on_car = (depth_m < 11) & (torch.arange(48)[:, None] < 30)
    assert valid[0][on_car].float().mean() > 0.75  # all but its rim
    assert (rgb[0] - truth)[valid[0]].abs().max() < 5e-3
    _, as_street = warp(target, now, depth_m, torch.ones(48, 64), source)
    assert not as_street[0][on_car].any()


def test_an_actor_absent_from_the_source_is_invalid(
    camera_at, board, draw, source_of, moving_track
):
    track = moving_track((10.0, 0.0, 1.0), (10.0, 0.0, 1.0), size_m=(1.0, 3.0, 3.0))
    boards = [board(10.0, left_m=1.5, right_m=-1.5, top_m=2.5)]
    source = source_of(camera_at(), boards, timestamp_ns=5 * SECOND_NS)
    _, _, valid = warp_one(camera_at(), boards, source, draw, [track])
    assert not valid[24, 26:38].any()


def test_the_road_under_an_actor_stays_with_the_street(moving_track):
    track = moving_track((10.0, 0.0, 1.0), (20.0, 0.0, 1.0))  # bottom of the box at z = 0
    points = torch.tensor(
        [[10.0, 0, 1.5], [10.0, 1.1, 0.5], [10.0, 1.1, 0.02], [10.0, 0, -0.05], [13.0, 0, 1.0]]
    )
    owners = MovingBoxes([track]).owners(points, 0)
    assert owners.tolist() == [0, 0, BACKGROUND, BACKGROUND, BACKGROUND]


def test_no_sources_give_no_colours(camera_at):
    nowhere = WarpTarget(camera_at(), 0, [torch.zeros(48, 64)], torch.ones(48, 64) > 0)
    warped = warped_references(nowhere, [], MovingBoxes([]), count=2)
    assert warped.rgb.shape == (2, 48, 64, 3)
    assert not warped.valid.any()
