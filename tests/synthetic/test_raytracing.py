"""Rays against worlds small enough to work out by hand."""

import numba
import numpy as np
import open3d
import pytest

from lidarpainter_models.synthetic.raytracing.lidar import cast_sweep
from lidarpainter_models.synthetic.raytracing.render import render_image
from lidarpainter_models.synthetic.raytracing.scene_arrays import (
    KIND_CUT_OUT,
    KIND_ROAD,
    InstanceArrays,
    ViewArrays,
)
from lidarpainter_models.synthetic.street import sample_offsets
from lidarpainter_models.synthetic.textures.noise import as_rgba
from lidarpainter_models.synthetic.textures.surfaces import StreetClass, Surface, SurfaceSet
from lidarpainter_models.synthetic.world.meshes import Mesh, MeshBuilder
from lidarpainter_models.synthetic.world.packing import light_array, pack_scene
from lidarpainter_models.synthetic.world.solids import add_ball, add_box, add_tube

WIDTH_PX, HEIGHT_PX = 40, 24
FOCAL_PX = 30.0
NO_ACTOR = -1


class World:
    """Surfaces and a mesh being built, then traced."""

    def __init__(self, sun=(0.0, 0.0, 1.0)):
        self.surfaces, self.builder = SurfaceSet(), MeshBuilder()
        air = {"haze_per_m": 1 / 1400, "cloud_texture": 0, "cloud_offset": (0.0, 0.0)}
        self.light = light_array(sun, sun_rgb=(2.5, 2.3, 1.95), **air)
        self.grey = self.surfaces.add(Surface(semantics=StreetClass.BUILDING, tint=(0.3, 0.3, 0.3)))

    def arrays(self, moving=()):
        street = self.builder.build()
        owners = np.full(len(street.surface), NO_ACTOR)
        return pack_scene(street, owners, list(moving), self.surfaces, self.light)


def looking_ahead(position=(0.0, 0.0, 1.5), offsets=None):
    """A camera that looks along the world's x."""
    pose = np.zeros((3, 4))
    pose[:, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pose[:, 3] = position
    return ViewArrays(
        world_from_camera=pose[None],
        intrinsics=np.array([FOCAL_PX, FOCAL_PX, WIDTH_PX / 2, HEIGHT_PX / 2]),
        offsets=sample_offsets(2) if offsets is None else offsets,
        footprint_px=0.5,
    )


def nothing_moving(times=1, is_lit=None):
    return InstanceArrays(
        roots=np.zeros((1, 0), np.int32),
        radius_m=np.zeros(0),
        world_from_box=np.zeros((times, 0, 3, 4)),
        contact=np.zeros((times, 0, 6)),
        is_lit=np.zeros((times, 0), np.float32) if is_lit is None else is_lit,
    )


def render(arrays, instances, view):
    return render_image(arrays, instances, view, HEIGHT_PX, WIDTH_PX)


def test_the_ground_has_the_worked_out_depth():
    world = World()
    world.builder.quad([-100, -100, 0], [300, 0, 0], [0, 200, 0], world.grey)
    arrays, _, _ = world.arrays()
    _, depth_m, semantics, actor = render(arrays, nothing_moving(), looking_ahead())
    v = np.arange(HEIGHT_PX) + 0.5 - HEIGHT_PX / 2
    expected = np.where(v > 0, 1.5 * FOCAL_PX / np.maximum(v, 1e-9), 0.0)
    assert np.allclose(depth_m, expected[:, None], rtol=1e-6)  # float32
    assert (semantics[v > 0] == StreetClass.BUILDING).all()
    assert (semantics[v < 0] == StreetClass.SKY).all()
    assert (actor == NO_ACTOR).all()


def test_a_wall_hides_what_is_behind_it():
    world = World()
    for distance in (30.0, 12.0, 20.0):
        world.builder.quad([distance, -50, -50], [0, 100, 0], [0, 0, 100], world.grey)
    arrays, _, _ = world.arrays()
    _, depth_m, _, _ = render(arrays, nothing_moving(), looking_ahead())
    assert np.allclose(depth_m, 12.0, rtol=1e-6)


def test_an_empty_world_is_all_sky():
    world = World()
    arrays, _, _ = world.arrays()
    rgb, depth_m, semantics, _ = render(arrays, nothing_moving(), looking_ahead())
    assert (depth_m == 0).all()
    assert (semantics == StreetClass.SKY).all()
    assert (rgb > 0.2).all()


@pytest.mark.parametrize("num_primitives", [1, 4, 5, 300])
def test_the_tree_finds_what_another_ray_tracer_finds(num_primitives):
    rng = np.random.default_rng(num_primitives)
    world = World()
    corner = rng.uniform([4, -6, -4], [30, 6, 7], (num_primitives, 3))
    corners = corner[:, None] + np.concatenate(
        [np.zeros((num_primitives, 1, 3)), rng.normal(0, 2, (num_primitives, 2, 3))], axis=1
    )
    is_parallelogram = bool(num_primitives % 2)
    uv = np.zeros((num_primitives, 3, 2))
    world.builder.primitives(corners, uv, world.grey, is_parallelogram=is_parallelogram)
    arrays, _, _ = world.arrays()
    view = looking_ahead(offsets=np.array([[0.5, 0.5]]))
    _, depth_m, _, _ = render(arrays, nothing_moving(), view)
    assert np.allclose(depth_m, nearest_by_open3d(corners, is_parallelogram), rtol=1e-4)


def nearest_by_open3d(corners, is_parallelogram):
    """Depth of the same rays by another ray tracer."""
    first, second, third = corners.swapaxes(0, 1)
    triangles = [np.stack([first, second, third], axis=1)]
    if is_parallelogram:
        triangles.append(np.stack([second, second + third - first, third], axis=1))
    vertices = np.concatenate(triangles).reshape(-1, 3).astype(np.float32)
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices, np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3))
    u = (np.arange(WIDTH_PX) + 0.5 - WIDTH_PX / 2) / FOCAL_PX
    v = (np.arange(HEIGHT_PX) + 0.5 - HEIGHT_PX / 2) / FOCAL_PX
    grid_v, grid_u = np.meshgrid(v, u, indexing="ij")
    along = np.stack([np.ones_like(grid_u), -grid_u, -grid_v], axis=-1)
    rays = np.concatenate([np.broadcast_to([0, 0, 1.5], along.shape), along], axis=-1)
    depth_m = scene.cast_rays(open3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()
    return np.where(np.isfinite(depth_m), depth_m, 0.0)


def test_rays_pass_through_the_holes_of_a_cut_out():
    world = World()
    opacity = np.zeros((16, 16))
    opacity[:, :8] = 1  # the left half is closed
    texture = world.surfaces.add_texture(as_rgba(np.full((16, 16, 3), 120.0), opacity))
    leaves = world.surfaces.add(
        Surface(semantics=StreetClass.VEGETATION, texture=texture, kind=KIND_CUT_OUT)
    )
    # texture s runs to the right as the camera sees it, which is -y
    world.builder.quad([10, 8, 9], [0, -16, 0], [0, 0, -16], leaves)
    world.builder.quad([25, -60, -60], [0, 120, 0], [0, 0, 120], world.grey)
    arrays, _, _ = world.arrays()
    _, depth_m, semantics, _ = render(arrays, nothing_moving(), looking_ahead())
    middle = depth_m[HEIGHT_PX // 2 - 4 : HEIGHT_PX // 2 + 4]
    assert np.allclose(middle[:, : WIDTH_PX // 2 - 2], 10.0)
    assert np.allclose(middle[:, WIDTH_PX // 2 + 2 :], 25.0)
    assert semantics[HEIGHT_PX // 2, 2] == StreetClass.VEGETATION


def test_a_roof_casts_its_shadow_straight_below_a_sun_in_the_zenith():
    world = World(sun=(0.0, 0.0, 1.0))
    world.builder.quad([-100, -100, 0], [300, 0, 0], [0, 200, 0], world.grey)
    world.builder.quad([6, -4, 8], [6, 0, 0], [0, 8, 0], world.grey)
    arrays, _, _ = world.arrays()
    rgb, depth_m, _, _ = render(arrays, nothing_moving(), looking_ahead())
    column = WIDTH_PX // 2
    ground = [line for line in range(HEIGHT_PX) if 0 < depth_m[line, column] < 40]
    bright = {line: float(rgb[line, column].mean()) for line in ground}
    shaded = [bright[line] for line in ground if 6.5 < depth_m[line, column] < 11.5]
    lit = [bright[line] for line in ground if not 5.5 < depth_m[line, column] < 12.5]
    assert max(shaded) < min(lit) - 0.1


def test_paint_is_told_from_the_road_by_the_fourth_channel():
    world = World()
    paint = np.zeros((8, 64))
    paint[:, :32] = 1
    texture = world.surfaces.add_texture(as_rgba(np.full((8, 64, 3), 90.0), paint))
    road = world.surfaces.add(Surface(semantics=StreetClass.ROAD, texture=texture, kind=KIND_ROAD))
    world.builder.quad([0, 20, 0], [0, -40, 0], [80, 0, 0], road)
    arrays, _, _ = world.arrays()
    _, _, semantics, _ = render(arrays, nothing_moving(), looking_ahead())
    assert semantics[-1, 2] == StreetClass.LANE_MARKING
    assert semantics[-1, -3] == StreetClass.ROAD


def moving_box(actor=3):
    """A moving cube of 2 m, in its box frame."""
    world = World()
    builder = MeshBuilder()
    add_box(builder, (0, 0, 0), (2.0, 2.0, 2.0), world.grey)
    return world, (builder.build(), actor)


def test_a_moving_mesh_is_drawn_where_its_box_is():
    world, cube = moving_box()
    arrays, roots, radius_m = world.arrays([cube])
    for ahead_m, yaw_rad in ((8.0, 0.0), (14.0, np.pi / 2)):
        pose = np.zeros((1, 1, 3, 4))
        cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
        pose[0, 0, :, :3] = [[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]
        pose[0, 0, :, 3] = ahead_m, 0.0, 1.5
        instances = nothing_moving()._replace(
            roots=roots[None], radius_m=radius_m, world_from_box=pose
        )
        _, depth_m, _, actor = render(arrays, instances, looking_ahead())
        middle = HEIGHT_PX // 2, WIDTH_PX // 2
        assert depth_m[middle] == pytest.approx(ahead_m - 1.0, rel=1e-5)
        assert actor[middle] == 3
        assert actor[0, 0] == NO_ACTOR


def test_each_lidar_column_sees_the_world_of_its_own_time():
    world, cube = moving_box()
    arrays, roots, radius_m = world.arrays([cube])
    columns, beams = 5, 3
    poses = np.zeros((columns, 1, 3, 4))
    poses[:, 0, :, :3] = np.eye(3)
    poses[:, 0, 0, 3] = 10.0 + np.arange(columns)  # the cube drives away
    lidar = np.zeros((columns, 3, 4))
    lidar[:, :, :3] = np.eye(3)
    lidar[:, 0, 3] = 0.25 * np.arange(columns)  # and the LiDAR follows
    shown = np.tile(roots, (columns, 1))
    instances = nothing_moving(columns)._replace(
        roots=shown, radius_m=radius_m, world_from_box=poses
    )
    inclinations = np.array([0.0, 0.02, 1.2])
    range_m, surface, label = cast_sweep(
        arrays, instances, lidar, np.zeros(columns), inclinations, 100.0
    )
    assert range_m.shape == (columns, beams)
    assert np.allclose(range_m[:, 0], 9.0 + 0.75 * np.arange(columns))
    assert np.isinf(range_m[:, 2]).all()
    assert (label[:, 0, 1] == 3).all()
    assert np.allclose(surface[:, 0, 2], 1.0)  # head-on


def wall_with(**looks):
    """A wall across the view."""
    world = World(sun=(-1.0, 0.0, 0.0))
    surface = world.surfaces.add(
        Surface(semantics=StreetClass.SIGN, tint=(0.2, 0.02, 0.03), **looks)
    )
    world.builder.quad([5, 9, 9], [0, -18, 0], [0, 0, -18], surface)
    return world.arrays()[0]


def test_a_lamp_adds_its_emission_while_it_is_lit_and_nothing_else():
    lit, dark = np.array([[0, 1]], np.float32), np.array([[1, 0]], np.float32)
    lamp = wall_with(emission=3.0, lamp=1)
    bright = render(wall_with(emission=3.0), nothing_moving(), looking_ahead())[0]
    plain = render(wall_with(), nothing_moving(), looking_ahead())[0]
    assert np.array_equal(render(lamp, nothing_moving(is_lit=lit), looking_ahead())[0], bright)
    assert np.array_equal(render(lamp, nothing_moving(is_lit=dark), looking_ahead())[0], plain)
    assert (bright[..., 0] > plain[..., 0] + 0.2).all()


def test_each_row_shows_the_lamps_of_its_own_time():
    is_lit = (np.arange(HEIGHT_PX) % 3 == 0).astype(np.float32)[:, None]
    view = looking_ahead()
    rows = view._replace(world_from_camera=np.repeat(view.world_from_camera, HEIGHT_PX, axis=0))
    moments = nothing_moving(HEIGHT_PX, is_lit)
    shown = render(wall_with(emission=3.0, lamp=0), moments, rows)[0]
    bright = render(wall_with(emission=3.0), nothing_moving(), view)[0]
    plain = render(wall_with(), nothing_moving(), view)[0]
    assert np.array_equal(shown, np.where(is_lit[..., None] > 0, bright, plain))


def test_closed_solids_have_no_holes():
    world = World()
    add_ball(world.builder, (0, 0, 0), (3, 3, 3), world.grey)
    arrays, _, _ = world.arrays()
    inside = looking_ahead(position=(0.1, 0.05, 0.02))
    _, depth_m, _, _ = render(arrays, nothing_moving(), inside)
    assert (depth_m > 0).all()


def test_a_capped_tube_is_as_long_and_thick_as_asked():
    world = World()
    add_tube(world.builder, (0, 0, 0), (0, 0, 4), (0.5, 0.5), world.grey, sides=24, has_caps=True)
    corners = world.builder.build().corners().reshape(-1, 3)
    assert np.allclose(corners.max(0), [0.5, 0.5, 4.0], atol=1e-9)
    assert np.allclose(corners.min(0), [-0.5, -0.5, 0.0], atol=1e-9)


def test_transforming_a_mesh_moves_its_corners():
    builder = MeshBuilder()
    builder.quad([1, 2, 3], [1, 0, 0], [0, 1, 0], 0)
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = 10, 20, 30
    moved = builder.build().transformed(pose)
    expected = np.array([[1, 2, 3], [2, 2, 3], [1, 3, 3], [2, 3, 3]]) @ pose[:3, :3].T + pose[:3, 3]
    assert np.allclose(moved.corners()[0], expected)
    assert np.allclose(Mesh.joined([moved, moved]).corners()[1], expected)


def test_images_do_not_depend_on_the_number_of_threads():
    rng = np.random.default_rng(5)
    world = World()
    corners = rng.uniform([4, -6, -4], [30, 6, 7], (60, 1, 3)) + rng.normal(0, 2, (60, 3, 3))
    world.builder.primitives(corners, np.zeros((60, 3, 2)), world.grey)
    arrays, _, _ = world.arrays()
    before = numba.get_num_threads()
    images = []
    try:
        for threads in (1, min(2, before)):
            numba.set_num_threads(threads)
            images.append(render(arrays, nothing_moving(), looking_ahead()))
    finally:
        numba.set_num_threads(before)
    for first, second in zip(*images, strict=True):
        assert np.array_equal(first, second)


def test_samples_are_symmetric_about_the_pixel_centre():
    for samples in (1, 2, 3):
        offsets = sample_offsets(samples)
        assert offsets.shape == (samples**2, 2)
        assert np.allclose(np.sort(offsets, axis=0), np.sort(1 - offsets, axis=0))
