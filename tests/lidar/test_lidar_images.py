from dataclasses import replace

import torch

from lidarpainter_models.geometry.cameras import Shutter
from lidarpainter_models.lidar import lidar_images
from lidarpainter_models.lidar.lidar_images import render_lidar
from lidarpainter_models.lidar.lidar_map import LidarMap, MapPoints
from lidarpainter_models.lidar.points_on_actors import MovingBoxes

SECOND_NS = 1_000_000_000
RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)


def points(xyz_m, rgb=RED, *, timestamp_ns=0, has_colour=True, range_m=None):
    xyz_m = torch.as_tensor(xyz_m, dtype=torch.float32).reshape(-1, 3)
    count = len(xyz_m)
    return MapPoints(
        xyz_m=xyz_m,
        rgb_u8=torch.tensor(rgb, dtype=torch.uint8).expand(count, 3).contiguous(),
        has_colour=torch.full((count,), has_colour),
        frame_index=torch.zeros(count, dtype=torch.int64),
        timestamp_ns=torch.full((count,), timestamp_ns, dtype=torch.int64),
        range_m=xyz_m.norm(dim=-1) if range_m is None else torch.full((count,), range_m),
    )


def street(*parts, actors=None):
    return LidarMap(street=MapPoints.concatenate(parts), actors=actors or {})


def wall(x_m, *, left_m, right_m, bottom_m, top_m, spacing_m):
    y_m = torch.arange(right_m, left_m, spacing_m)
    z_m = torch.arange(bottom_m, top_m, spacing_m)
    y_m, z_m = torch.meshgrid(y_m, z_m, indexing="ij")
    return torch.stack([torch.full_like(y_m, x_m), y_m, z_m], dim=-1).reshape(-1, 3)


def whole_wall(x_m, spacing_m=0.1):
    return wall(x_m, left_m=x_m, right_m=-x_m, bottom_m=-x_m, top_m=x_m, spacing_m=spacing_m)


def test_a_dense_wall_fills_the_image(camera_at):
    image = render_lidar(street(points(whole_wall(10.0))), MovingBoxes([]), camera_at(), 0)
    assert image.hit.all()
    assert torch.allclose(image.rgb, torch.tensor([1.0, 0, 0]).expand_as(image.rgb))
    assert torch.allclose(image.depth_m, torch.tensor(10.0))


def test_an_empty_map_gives_a_black_image(camera_at):
    image = render_lidar(street(points(torch.zeros(0, 3))), MovingBoxes([]), camera_at(), 0)
    assert not image.hit.any()
    assert (image.rgb == 0).all()
    assert (image.depth_m == 0).all()


def test_background_does_not_show_between_foreground_points(camera_at, monkeypatch):
    # foreground points 4 px apart, each a disc of 1 px: most of its pixels have no point
    near = wall(5.0, left_m=1.0, right_m=-1.0, bottom_m=0.5, top_m=2.5, spacing_m=0.33)
    far = points(whole_wall(20.0), GREEN)
    monkeypatch.setattr(lidar_images, "HIDDEN_REACH_RAD", 0.1)
    image = render_lidar(street(points(near), far), MovingBoxes([]), camera_at(), 0)
    inside = image.rgb[16:32, 24:40]  # well within the foreground
    assert (inside[..., 1] == 0).all()
    assert inside[..., 0].max() == 1
    assert image.rgb[:, :16, 1].min() == 1  # beside it the background is whole


def test_dense_foreground_keeps_its_silhouette(camera_at):
    near = wall(5.0, left_m=1.0, right_m=-1.0, bottom_m=-5.0, top_m=5.0, spacing_m=0.05)
    image = render_lidar(
        street(points(near), points(whole_wall(20.0), GREEN)), MovingBoxes([]), camera_at(), 0
    )
    # the wall spans columns 20..44; its discs would reach one pixel further
    assert (image.rgb[:, 21:43, 0] == 1).all()
    assert (image.rgb[:, :19, 1] == 1).all()
    assert (image.rgb[:, 45:, 1] == 1).all()


def test_a_road_at_a_grazing_angle_is_not_culled(camera_at):
    x_m, y_m = torch.meshgrid(
        torch.cat([torch.arange(3.0, 20, 0.05), torch.arange(20, 60.0, 0.2)]),
        torch.arange(-6.0, 6.0, 0.1),
        indexing="ij",
    )
    road = torch.stack([x_m, y_m, torch.zeros_like(x_m)], dim=-1)
    image = render_lidar(street(points(road)), MovingBoxes([]), camera_at(), 0)
    # rows 27 (30 m) to 47 (4 m) see it, and depths grow by up to a third from row to row
    rows = torch.arange(27, 48)
    assert image.hit[rows, 31].all()
    expected_m = 1.5 * 60 / (rows + 0.5 - 24)
    assert ((image.depth_m[rows, 31] / expected_m - 1).abs() < 0.2).all()


def half_wall(x_m):
    return wall(x_m, left_m=x_m, right_m=0.0, bottom_m=-x_m, top_m=x_m, spacing_m=0.1)


def test_older_points_fill_only_what_newer_ones_leave_open(camera_at):
    new = points(half_wall(10.0))
    old = points(whole_wall(8.0), BLUE, timestamp_ns=-3 * SECOND_NS)
    image = render_lidar(street(new, old), MovingBoxes([]), camera_at(), 0)
    # the older wall stands in front, but the newer one was seen through it
    assert (image.rgb[:, :30, 0] == 1).all()
    assert (image.rgb[:, 34:, 2] == 1).all()


def test_points_out_of_reach_in_time_are_not_drawn(camera_at):
    new = points(half_wall(10.0))
    old = points(whole_wall(8.0), BLUE, timestamp_ns=-11 * SECOND_NS)
    image = render_lidar(street(new, old), MovingBoxes([]), camera_at(), 0)
    assert not image.hit[:, 34:].any()


def test_ahead_of_the_log_the_newest_points_are_drawn(camera_at):
    newest = points(whole_wall(10.0), timestamp_ns=-5 * SECOND_NS)
    older = points(whole_wall(9.0), BLUE, timestamp_ns=-8 * SECOND_NS)
    image = render_lidar(street(older, newest), MovingBoxes([]), camera_at(), 0)
    assert (image.rgb[..., 0] == 1).all()


def test_newer_points_outweigh_older_ones(camera_at):
    wall_m = whole_wall(10.0)
    old, new = points(wall_m, BLUE, timestamp_ns=-SECOND_NS), points(wall_m, RED)
    image = render_lidar(street(old, new), MovingBoxes([]), camera_at(), 0)
    assert image.rgb[..., 0].min() > 0.9  # e^-2.5 of blue


def test_actors_are_carried_by_their_track_and_absent_ones_left_out(camera_at, moving_track):
    side = wall(0.0, left_m=1.0, right_m=-1.0, bottom_m=-1.0, top_m=1.0, spacing_m=0.05)
    actor = points(side, BLUE, timestamp_ns=40 * SECOND_NS, range_m=10.0)
    lidar_map = street(points(torch.zeros(0, 3)), actors={"car": actor})
    track = moving_track((10.0, 3.0, 1.5), (10.0, -3.0, 1.5))
    image = render_lidar(lidar_map, MovingBoxes([track]), camera_at(), SECOND_NS)
    columns = image.hit.any(dim=0).nonzero()[:, 0]
    assert columns.min() in (43, 44)  # u = 32 + 60 * (3 -+ 1) / 10
    assert columns.max() in (55, 56)
    assert (image.rgb[image.hit] == torch.tensor([0, 0, 1.0])).all()
    assert not render_lidar(lidar_map, MovingBoxes([track]), camera_at(), 9 * SECOND_NS).hit.any()
    assert not render_lidar(lidar_map, MovingBoxes([]), camera_at(), SECOND_NS).hit.any()


def test_actors_beyond_the_edge_of_the_image_are_left_out(camera_at, moving_track):
    patch = wall(0.0, left_m=1.0, right_m=-1.0, bottom_m=-1.0, top_m=1.0, spacing_m=0.05)
    aside = replace(moving_track((8.0, 40.0, 0.0), (8.0, 40.0, 0.0)), actor_id="b")
    ahead = moving_track((8.0, 0.0, 0.0), (8.0, 0.0, 0.0))
    both = {ahead.actor_id: points(patch, GREEN), "b": points(patch, BLUE)}
    images = [
        render_lidar(street(points(whole_wall(20.0)), actors=actors), boxes, camera_at(), 0)
        for actors, boxes in (
            (both, MovingBoxes([ahead, aside])),
            ({ahead.actor_id: both[ahead.actor_id]}, MovingBoxes([ahead])),
        )
    ]
    assert bool((images[0].rgb[..., 1] == 1).any())
    assert torch.equal(images[0].rgb, images[1].rgb)


def test_a_thinned_map_looks_the_same_from_afar(camera_at):
    sweeps = [points(whole_wall(10.0, 0.02 + 0.001 * number)) for number in range(4)]
    whole = street(*sweeps)
    thin = whole.thinned(0.01)
    assert len(thin.street) < len(whole.street) / 8
    images = [render_lidar(each, MovingBoxes([]), camera_at(), 0) for each in (whole, thin)]
    assert images[1].hit.all()
    assert torch.allclose(images[0].depth_m, images[1].depth_m)


def test_a_thinned_map_keeps_what_has_a_colour_and_each_range():
    place = [[10.0, 0.0, 0.0]] * 4
    bare, red = points(place, has_colour=False), points(place, timestamp_ns=SECOND_NS)
    far = points(place, BLUE, range_m=100.0)
    thin = MapPoints.concatenate([bare, red, far]).thinned(0.01)
    assert thin.has_colour.tolist() == [True, True]
    assert thin.rgb_u8.tolist() == [list(RED), list(BLUE)]
    assert thin.timestamp_ns.tolist() == [SECOND_NS, 0]


def test_points_without_colour_hide_and_give_depth_but_are_no_hit(camera_at):
    bare = points(whole_wall(5.0), has_colour=False)
    image = render_lidar(
        street(bare, points(whole_wall(20.0), GREEN)), MovingBoxes([]), camera_at(), 0
    )
    assert torch.allclose(image.depth_m, torch.tensor(5.0))
    assert not image.hit.any()
    assert (image.rgb == 0).all()


def test_a_gap_in_one_surface_is_closed_but_its_outside_is_not(camera_at, monkeypatch):
    wall_m = wall(10.0, left_m=2.0, right_m=-2.0, bottom_m=-0.5, top_m=3.5, spacing_m=0.1)
    gap = ((wall_m[:, 1].abs() < 0.25) & ((wall_m[:, 2] - 1.5).abs() < 0.25))[:, None]
    monkeypatch.setattr(lidar_images, "BEAM_SPACING_RAD", 0.04)
    monkeypatch.setattr(lidar_images, "MAX_RADIUS_RAD", 0.03)
    image = render_lidar(street(points(wall_m[~gap[:, 0]])), MovingBoxes([]), camera_at(), 0)
    assert image.hit[20:28, 28:36].all()
    assert not image.hit[:, :17].any()


def test_points_are_where_a_rolling_shutter_reads_them(camera_at):
    shutter = Shutter(
        across_s=(0.0, 0.03), twist_per_s=torch.tensor([0.0, 0.0, 0.0, 60.0, 0.0, 0.0])
    )
    camera = replace(camera_at(), shutter=shutter)
    posts = [
        wall(8.0, left_m=y, right_m=y - 0.1, bottom_m=z, top_m=z + 0.1, spacing_m=0.1)
        for y in (-2.0, 2.0)
        for z in (-1.0, 4.0)
    ]
    world = torch.cat(posts)
    image = render_lidar(street(points(world)), MovingBoxes([]), camera, 0)
    pixels_uv, depth_m = camera.project(world)
    assert bool(camera.contains(pixels_uv, depth_m).all())
    column, row = pixels_uv.long().unbind(-1)
    assert bool(image.hit[row, column].all())
    standing_uv, _ = replace(camera, shutter=None).project(world)
    assert float((standing_uv - pixels_uv).norm(dim=-1).min()) > 3
    apart = replace(camera, shutter=None)
    assert not bool(
        render_lidar(street(points(world)), MovingBoxes([]), apart, 0).hit[row, column].any()
    )
