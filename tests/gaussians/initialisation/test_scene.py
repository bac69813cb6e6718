from dataclasses import fields, replace

import pytest
import torch
from gaussian_world import (
    FRAME_NS,
    HEIGHT_PX,
    WIDTH_PX,
    camera_at,
    car_track,
    map_points,
    scene_of,
    training_view,
)

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.initialisation import adaptive_voxels as thinning
from lidarpainter_models.gaussians.initialisation.adaptive_voxels import (
    Cloud,
    adaptive_voxels,
    mean_by_voxel,
    voxel_keys,
)
from lidarpainter_models.gaussians.initialisation.scene import (
    _spread_cameras,
    initialise_scene,
    pixel_footprint,
)
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.gaussians.initialisation.surfels import (
    fill_colours,
    surfels_from_points,
    within_outlines,
)
from lidarpainter_models.geometry.transforms import rotation_from_quaternion
from lidarpainter_models.lidar.lidar_map import LidarMap
from lidarpainter_models.scenes.camera_faults import CameraFault


def plane(count=400, seed=0):
    """Points on z = 0."""
    xy = torch.rand(count, 2, generator=torch.Generator().manual_seed(seed)) * 4
    return torch.cat([xy, torch.zeros(count, 1)], dim=1)


def test_points_of_one_voxel_become_their_mean():
    xyz_m = torch.tensor([[0.01, 0.0, 0.0], [0.03, 0.0, 0.0], [0.15, 0.0, 0.0]])
    rgb_u8 = torch.tensor([[255, 0, 0], [0, 255, 0], [0, 0, 255]], dtype=torch.uint8)
    has_colour = torch.tensor([True, False, True])
    cloud = Cloud(xyz_m=xyz_m, rgb_u8=rgb_u8, has_colour=has_colour, spacing_m=torch.ones(3))
    voxels = mean_by_voxel(cloud, torch.full((3,), 0.1))
    order = voxels.xyz_m[:, 0].argsort()
    assert torch.allclose(voxels.xyz_m[order][:, 0], torch.tensor([0.02, 0.15]))
    assert torch.allclose(voxels.rgb[order], torch.tensor([[1.0, 0, 0], [0, 0, 1.0]]))
    assert voxels.num_points[order].tolist() == [2, 1]


@pytest.mark.parametrize("count", [0, 1, 50])
def test_pieces_of_a_cloud_change_no_bit(count, monkeypatch):
    cloud = cloud_of(plane(count), 0.3)
    sizes = cloud.sizes(1.0)

    def found():
        voxels = mean_by_voxel(cloud, sizes)
        return [voxel_keys(cloud.xyz_m, sizes), *(getattr(voxels, f.name) for f in fields(voxels))]

    whole = found()
    monkeypatch.setattr(thinning, "POINTS_AT_ONCE", 7)
    assert all(map(torch.equal, found(), whole))


def cloud_of(xyz_m, spacing_m):
    count = len(xyz_m)
    return Cloud(
        xyz_m=xyz_m,
        rgb_u8=torch.randint(256, (count, 3), dtype=torch.uint8),
        has_colour=torch.ones(count, dtype=torch.bool),
        spacing_m=torch.as_tensor(spacing_m).expand(count),
    )


@pytest.mark.parametrize("budget", [1, 50, 300, 10_000])
def test_voxel_budget_is_kept(budget):
    (voxels,) = adaptive_voxels([cloud_of(plane(2000), 0.01)], budget=budget)
    assert 1 <= len(voxels.xyz_m) <= budget


@pytest.mark.parametrize("budget", [300, 2000])
def test_a_spacing_asks_for_as_much_on_every_body(budget):
    """Of two like surfaces, one with four times the points, each gets its half."""
    street, car = cloud_of(plane(20_000), 0.01), cloud_of(plane(80_000), 0.01)
    on_street, on_car = adaptive_voxels([street, car], budget=budget)
    assert len(on_street.xyz_m) + len(on_car.xyz_m) <= budget
    assert len(on_street.xyz_m) == pytest.approx(len(on_car.xyz_m), rel=0.1)


def test_far_points_get_larger_voxels():
    near, far = plane(3000), plane(3000) + torch.tensor([100.0, 0, 0])
    footprint = torch.cat([torch.full((3000,), 0.01), torch.full((3000,), 0.08)])
    (voxels,) = adaptive_voxels([cloud_of(torch.cat([near, far]), footprint)], budget=1500)
    is_far = voxels.xyz_m[:, 0] > 50
    assert float(voxels.size_m[is_far].mean()) > 4 * float(voxels.size_m[~is_far].mean())


def test_surfels_lie_in_their_surface():
    gaussians = surfels_from_points(plane(), torch.rand(400, 3))
    normal = rotation_from_quaternion(gaussians.rotation_wxyz)[:, :, 0]
    assert float(normal[:, 2].abs().min()) > 0.999
    scale_m = gaussians.scale_m
    assert torch.allclose(scale_m[:, 0], 0.15 * scale_m[:, 1], rtol=1e-4)
    assert torch.equal(scale_m[:, 1], scale_m[:, 2])
    assert abs(float(scale_m[:, 1].median()) - 0.6 * 0.15) < 0.05


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_a_handful_of_points_is_enough(count):
    gaussians = surfels_from_points(plane(count), torch.rand(count, 3))
    assert len(gaussians) == count
    assert bool(gaussians.log_scale.isfinite().all())
    assert bool(gaussians.rotation_wxyz.isfinite().all())


def test_surfel_shows_its_colour():
    rgb = torch.rand(50, 3)
    gaussians = surfels_from_points(plane(50), rgb)
    assert torch.allclose(gaussians.base_rgb, rgb, atol=1e-6)


def test_a_wire_hides_no_tower_behind_it():
    """Its points lie 3 m apart, 20 m ahead, in an image of sky but for a tower and the wire."""
    camera = camera_at(0.0, width_px=96, height_px=64)
    y_m = torch.arange(-9.0, 9.1, 3.0)
    wire_m = torch.stack([torch.full_like(y_m, 20.0), y_m, torch.full_like(y_m, 5.0)], dim=1)
    row = int(camera.project(wire_m)[0][0, 1])
    surface = torch.zeros(64, 96, dtype=torch.bool)
    surface[row] = True
    surface[row - 15 :, 40:56] = True
    view = training_view(camera, sky_mask=~surface)
    discs = surfels_from_points(wire_m, torch.full((7, 3), 0.3))
    within = within_outlines(discs, [view])
    tower = surface.clone()
    tower[row - 2 : row + 3] = False
    share_hidden = {
        name: float((scene_of(one, [camera]).render(camera, 0).alpha > 0.1)[tower].float().mean())
        for name, one in (("discs", discs), ("within", within))
    }
    assert share_hidden["discs"] > 0.5
    assert share_hidden["within"] < 0.2
    depth_m = camera.project(within.means)[1]
    sigma_px = within.scale_m[:, 2] / depth_m * camera.fx_px
    on_tower = y_m.abs() < 2
    assert float(sigma_px[~on_tower].max()) == pytest.approx(0.7, abs=1e-3)
    assert 1 < float(sigma_px[on_tower]) < 5
    free = replace(view, sky_mask=torch.zeros_like(surface))
    assert torch.equal(within_outlines(discs, [free]).log_scale, discs.log_scale)


def test_points_without_colour_take_that_of_their_neighbours():
    xyz_m = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0.9, 0, 0]])
    rgb = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [9.0, 9, 9]])
    has_colour = torch.tensor([True, True, False])
    filled = fill_colours(xyz_m, rgb, has_colour)
    assert filled[2].tolist() == [0.5, 0.5, 0.0]
    grey = fill_colours(xyz_m, rgb, torch.zeros(3, dtype=torch.bool))
    assert torch.equal(grey, torch.full((3, 3), 0.5))


def test_footprint_knows_in_beside_and_out_of_the_image():
    camera = camera_at(0.0)
    points = torch.tensor([[8.0, 0, 1.0], [8.0, 7.0, 1.0], [8.0, 30.0, 1.0], [-5.0, 0, 1.0]])
    footprint, density = pixel_footprint(points, [camera])
    assert (density > 0).tolist() == [True, False, False, False]
    assert float(density[0]) == pytest.approx((camera.fx_px / 8.0) ** 2)
    _, of_four = pixel_footprint(points, 4 * [camera])
    assert float(of_four[0]) == pytest.approx(2 * float(density[0]))
    assert footprint.isfinite().tolist() == [True, True, False, False]
    assert abs(float(footprint[0]) - 8.0 / camera.fx_px) < 1e-6


def test_first_scene_keeps_its_size_and_bodies(world):
    config = InitialisationConfig(num_gaussians=500, street_voxel_m=0.1)
    scene = initialise_scene(world.observations, config)
    assert 300 < scene.num_gaussians <= 500
    assert set(scene.gaussians.body_index.tolist()) == {0, 1}
    view = world.observations.views[0]
    error = (scene.render(view.camera, view.timestamp_ns).rgb - view.rgb).abs().mean()
    plain = (torch.full_like(view.rgb, 0.5) - view.rgb).abs().mean()
    assert float(error) < float(plain)


def test_actor_never_near_a_image_is_not_modelled(world):
    config = InitialisationConfig(num_gaussians=500, street_voxel_m=0.1)
    track = world.observations.tracks[0]
    behind = track.world_from_box.clone()
    behind[:, 0, 3] = -50.0
    away = replace(world.observations, tracks=(replace(track, world_from_box=behind),))
    scene = initialise_scene(away, config)
    assert int((scene.gaussians.body_index > 0).sum()) == 0


def test_an_actor_that_one_camera_of_six_sees_is_modelled(world):
    config = InitialisationConfig(num_gaussians=500, street_voxel_m=0.1)
    views = []
    for frame in range(14):
        for camera, x_m in enumerate((50.0, 0.0, 50.0, 50.0, 50.0, 50.0)):
            view = world.observations.views[0]
            views.append(replace(view, key=(frame, f"camera-{camera}"), camera=camera_at(x_m)))
    scene = initialise_scene(replace(world.observations, views=tuple(views)), config)
    assert int((scene.gaussians.body_index > 0).sum()) > 0


def test_an_actor_that_is_there_for_a_moment_of_a_long_log_is_modelled(world):
    config = InitialisationConfig(num_gaussians=500, street_voxel_m=0.1)
    view = world.observations.views[0]
    views = [
        replace(view, key=(frame, "front"), timestamp_ns=(frame - 33) * 100_000_000)
        for frame in range(120)
    ]
    scene = initialise_scene(replace(world.observations, views=tuple(views)), config)
    assert int((scene.gaussians.body_index > 0).sum()) > 0


def test_first_scene_holds_what_was_found_of_the_cameras(world):
    late = CameraFault(late_s=0.012)
    views = tuple(
        replace(view, timestamp_ns=view.timestamp_ns + index * 3_000_000_000)
        for index, view in enumerate(world.observations.views)
    )
    known = replace(world.observations, views=views, faults={"front": late})
    scene = initialise_scene(known, InitialisationConfig(num_gaussians=300, street_voxel_m=0.1))
    assert scene.cameras.faults == {"front": late}
    times_ns = [view.timestamp_ns for view in views]
    assert scene.exposure.knots_ns[0] == min(times_ns)
    assert scene.exposure.knots_ns[-1] == pytest.approx(max(times_ns), abs=len(times_ns))


def test_map_out_of_sight_is_one_clear_error(world):
    nothing = map_points(torch.full((5, 3), -99.0), torch.zeros(5, 3))
    blind = replace(world.observations, lidar_map=LidarMap(street=nothing, actors={}), tracks=())
    with pytest.raises(ConfigError, match="no LiDAR point"):
        initialise_scene(blind, InitialisationConfig(num_gaussians=100))


def walker(category="Pedestrian", ahead_m=6.0, actor_id="ann"):
    """Somebody of 1.8 m before the cameras of the world, who walks to the left."""
    track = car_track(4)
    poses = track.world_from_box.clone()
    poses[:, 0, 3], poses[:, 1, 3] = ahead_m, 0.1 * poses[:, 1, 3]
    return replace(
        track,
        actor_id=actor_id,
        category=category,
        size_m=torch.tensor([0.7, 0.6, 1.8]),
        world_from_box=poses,
    )


def with_walkers(world, tracks, *, frame_ns=FRAME_NS):
    """The observations with walkers of the car's points, and images twice as fine."""
    seen = world.observations
    views = [
        replace(
            view,
            camera=camera_at(0.3 * row, width_px=2 * WIDTH_PX, height_px=2 * HEIGHT_PX),
            timestamp_ns=row * frame_ns,
            rgb_u8=view.rgb_u8.repeat_interleave(2, 0).repeat_interleave(2, 1),
            sky_mask=view.sky_mask.repeat_interleave(2, 0).repeat_interleave(2, 1),
            lidar_depth_m=view.lidar_depth_m.repeat_interleave(2, 0).repeat_interleave(2, 1),
        )
        for row, view in enumerate(seen.views)
    ]
    points = {track.actor_id: seen.lidar_map.actors["car"] for track in tracks}
    lidar_map = LidarMap(street=seen.lidar_map.street, actors=points)
    return replace(seen, views=tuple(views), tracks=tuple(tracks), lidar_map=lidar_map)


def bent_bodies(observations):
    config = InitialisationConfig(num_gaussians=600, street_voxel_m=0.2)
    return initialise_scene(observations, config).actors.bending.bodies.tolist()


def test_people_who_are_seen_well_may_bend(world):
    tracks = [
        walker("Car", actor_id="car"),
        walker(),
        walker(ahead_m=20.0, actor_id="far"),
        walker("human.pedestrian.adult", actor_id="bob"),
    ]
    assert bent_bodies(with_walkers(world, tracks)) == [2, 4]


def test_frames_too_far_apart_show_no_steps(world):
    assert bent_bodies(with_walkers(world, [walker()], frame_ns=2 * FRAME_NS)) == [1]
    assert bent_bodies(with_walkers(world, [walker()], frame_ns=5 * FRAME_NS)) == []


def test_a_camera_that_stands_is_asked_once_and_counts_for_all_its_images(world):
    points = world.observations.lidar_map.street.xyz_m
    camera = camera_at(0.3)
    footprint, density = pixel_footprint(points, [camera, camera_at(2.0)], [3, 1])
    again, of_all = pixel_footprint(points, [*3 * [camera], camera_at(2.0)])
    assert torch.equal(footprint, again)
    assert torch.allclose(density, of_all)
    views = world.observations.views
    stood = [replace(views[0], key=(row, "front")) for row in range(5)] + [views[3]]
    cameras, images = _spread_cameras(stood)
    assert [one.centre_world.tolist() for one in cameras] == [
        one.camera.centre_world.tolist() for one in (views[0], views[3])
    ]
    assert images == [5, 1]
