"""Actors come out whole, go elsewhere, and what they leave is mended."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import FRAME_NS, build_world, camera_at, map_points, round_gaussians

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.editing.actor_models import (
    MAX_CAST,
    ActorModel,
    contact_shadow,
    exposure_gain,
)
from lidarpainter_models.editing.apply import edited, encounters, refuse_walls
from lidarpainter_models.editing.filled_scenes import filled, masked_observations
from lidarpainter_models.editing.motions import AFTER_NS, LogTimes
from lidarpainter_models.editing.script import ActorSource, parse_operations
from lidarpainter_models.editing.worlds import EditedWorld
from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.gaussians.model.blinking import Blinking
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.lidar.lidar_map import LidarMap, MapPoints

GUEST = {"op": "insert", "name": "guest", "source": {"actor": "car"}}
LAMPS = {"op": "lamps", "actor": "car", "state": "on"}
MOVE = {"op": "move", "actor": "car"}
TIMES_NS = torch.arange(4) * FRAME_NS
GROUND_M = -0.1
PARKED_POSE = rigid_from_tangent(torch.tensor([0, 0, 0, 5.0, 3.0, 0.5]).double())


def ground(step_m=0.1):
    """Grey road around the car."""
    xy = torch.cartesian_prod(torch.arange(2, 12, step_m), torch.arange(-6, 6, step_m))
    return torch.cat([xy, torch.full((len(xy), 1), GROUND_M)], dim=1)


@pytest.fixture(scope="module")
def world():
    """A car that drives to the left on a grey road before a wall; the ego stands nearly still."""
    made = build_world()
    road_m = ground()
    grey = torch.full((len(road_m), 3), 0.4)
    road = round_gaussians(road_m, grey, sigma_m=0.08)
    street = MapPoints.concatenate([made.observations.lidar_map.street, map_points(road_m, grey)])
    scene = made.scene.with_gaussians(made.scene.gaussians.append(road))
    tangents = torch.zeros(4, 6, dtype=torch.float64)
    tangents[:, 3] = 0.3 * torch.arange(4)
    ego = DrivenPath(timestamps_ns=TIMES_NS, world_from_body=rigid_from_tangent(tangents))
    return EditedWorld(
        scene=scene,
        fitted=scene,
        lidar_map=LidarMap(street=street, actors=made.observations.lidar_map.actors),
        views=made.observations.views,
        parked=(),
        log=LogTimes(ego=ego),
    )


def done(world, *operations, models=None):
    return edited(world, parse_operations([*operations], "test"), models or {}, {})


def places(world, name="car"):
    (track,) = [track for track in world.moving if track.actor_id == name]
    return torch.stack([track.pose_at(int(time))[:3, 3] for time in TIMES_NS])


def test_a_removed_actor_leaves_no_gaussian_no_point_and_no_track(world):
    after = done(world, {"op": "remove", "actors": ["car"]})
    assert int(after.scene.gaussians.body_index.max()) == 0
    assert after.scene.tracks == () == after.moving
    assert after.lidar_map.actors == {}
    assert len(world.scene.tracks) == 1  # the source stays as it is


@pytest.mark.parametrize(
    ("operation", "expected_y_m"),
    [
        ({"op": "move", "trajectory": "along:2"}, [0, 1, 2, 3]),
        ({"op": "stop", "at_s": 0.1, "over_s": 0}, [-2, -1, -1, -1]),
        ({"op": "stop", "at_s": 0.1, "over_s": 0.2}, [-2, -1, -0.25, 0]),
        ({"op": "retime", "delay_s": 0.1}, [-2, -2, -1, 0]),
        ({"op": "retime", "speed": 2}, [-2, 0, 1, 1]),
        ({"op": "scale", "factor": 2}, [-2, -1, 0, 1]),
    ],
)
def test_an_actor_goes_another_way(world, operation, expected_y_m):
    after = done(world, operation | {"actor": "car"})
    assert places(after)[:, 1].tolist() == pytest.approx(expected_y_m, abs=1e-6)
    assert len(after.lidar_map.actors["car"]) == 120


def test_a_larger_actor_keeps_its_wheels_on_the_road(world):
    before, after = world.moving[0], done(world, {"op": "scale", "actor": "car", "factor": 2})
    larger = after.moving[0]
    assert larger.size_m.tolist() == pytest.approx((2 * before.size_m).tolist())
    bottoms = [
        float(track.world_from_box[0, 2, 3] - track.size_m[2] / 2) for track in (before, larger)
    ]
    assert bottoms[0] == pytest.approx(bottoms[1])


def test_who_is_moved_shows_its_lamps_as_on_average_and_who_goes_takes_them_along(world):
    lamp = Blinking.dark(torch.tensor([1, 0]), torch.zeros(2, 3), torch.full((2, 3), 9.0))
    lamp.lit_rgb[:] = 0.1
    lamp = replace(lamp, is_lit=torch.tensor([[0.0, 1.0], [1.0, 1.0]]), knots_ns=TIMES_NS[:2])
    lit = replace(world, scene=replace(world.scene, blinking=lamp))
    car, before = (one.model_of(one.moving[0]).gaussians for one in (lit, world))
    assert torch.allclose(car.base_rgb - before.base_rgb, torch.full((120, 3), 0.05), atol=1e-6)
    after = done(lit, {"op": "move", "actor": "car", "trajectory": "along:2"})
    assert after.scene.blinking.bodies.tolist() == [0]
    removed = done(lit, {"op": "remove", "actors": ["car"]})
    assert removed.scene.blinking.bodies.tolist() == [0]


def test_time_can_be_frozen(world):
    after = done(world, {"op": "freeze", "at_s": 0.2})
    assert places(after)[:, 1].tolist() == pytest.approx([0, 0, 0, 0])


def test_a_guest_takes_the_light_of_the_scene_and_throws_a_shadow(world):
    model = world.model_of(world.moving[0])
    dim = replace(model, road_rgb=world.road_rgb / 2)
    source = ActorSource(run="other", actor="guest")
    operation = GUEST | {"source": source.model_dump(exclude_defaults=True)}
    operation |= {"ahead_m": 5, "left_m": 3, "speed_mps": 0}
    after = done(world, operation, models={source: dim})
    assert places(after, "guest")[:, :2].tolist() == [[5, 3]] * 4
    bottom_m = float(places(after, "guest")[0, 2] - model.size_m[2] / 2)
    assert bottom_m == pytest.approx(GROUND_M, abs=0.02)
    guest = after.model_of(after.find("guest")).gaussians
    shadow = contact_shadow(model.size_m, sh_degree=1)
    assert len(guest) == len(model.gaussians) + len(shadow)
    mine = guest.base_rgb[: len(model.gaussians)]
    assert torch.allclose(mine, 2 * model.gaussians.base_rgb, atol=1e-4)
    again = done(after, {"op": "move", "actor": "guest", "trajectory": "lateral:1"})
    assert len(again.model_of(again.find("guest")).gaussians) == len(guest)  # one shadow


def test_the_light_of_another_scene_is_taken_and_given_back(world):
    """Brightness and tint come from the road; a road of another colour gives a limited tint."""
    model = world.model_of(world.moving[0])
    warm = world.road_rgb * torch.tensor([1.32, 1.2, 1.08])
    lit = model.exposed_like(warm)
    expected = model.gaussians.base_rgb * warm / world.road_rgb
    assert torch.allclose(lit.gaussians.base_rgb, expected, atol=1e-6)
    back = lit.exposed_like(world.road_rgb)
    assert torch.allclose(back.gaussians.base_rgb, model.gaussians.base_rgb, atol=1e-6)
    brick = torch.tensor([0.6, 0.2, 0.2])
    gain = exposure_gain(world.road_rgb, brick)
    brightness = float(brick.mean() / world.road_rgb.mean())
    assert float(gain[0]) == pytest.approx(MAX_CAST * brightness, rel=0.02)


@pytest.fixture(scope="module")
def standing(world):
    """A dark car stands on a road that nobody saw under it."""
    size_m = torch.tensor([3.0, 1.6, 1.2])
    pose = PARKED_POSE
    parked = replace(
        world.moving[0],
        actor_id="parked",
        is_moving=False,
        size_m=size_m,
        world_from_box=pose.expand(4, 4, 4),
    )
    inside = (torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) - 0.5) * size_m * 0.9
    car_m = inside + pose[:3, 3].float()
    car_m = car_m[car_m[:, 2] > GROUND_M + 0.15]
    dark = torch.full((len(car_m), 3), 0.05)
    scene, street = world.scene, world.lidar_map.street
    hidden = ((ground() - pose[:3, 3].float()).abs()[:, :2] < size_m[:2] / 2).all(dim=1)
    road = scene.gaussians.means.shape[0] - len(ground())
    seen = torch.cat([torch.arange(road), road + (~hidden).nonzero()[:, 0]])
    gaussians = scene.gaussians.select(seen).append(round_gaussians(car_m, dark, sigma_m=0.1))
    wall = len(street) - len(ground())
    points = street.keep(torch.cat([torch.arange(wall), wall + (~hidden).nonzero()[:, 0]]))
    return replace(
        world,
        scene=scene.with_gaussians(gaussians),
        fitted=scene.with_gaussians(gaussians),
        lidar_map=LidarMap(street=points, actors=world.lidar_map.actors),
        parked=(parked,),
    )


def test_the_road_under_a_removed_parked_car_is_mended(standing):
    after = done(standing, {"op": "remove", "actors": ["parked"]})
    mended = filled(after, ConditionConfig(num_references=1, num_sources=1), None)
    camera = camera_at(0.0)
    above = camera.at(PARKED_POSE @ torch.diag(torch.tensor([1.0, -1, -1, 1])).double())
    above.world_from_camera[2, 3] = 4.0
    bare, whole = (one.render(above, 0) for one in (after.scene, mended.scene))
    middle = (slice(20, 28), slice(28, 36))
    assert float(bare.alpha[middle].max()) < 0.5
    assert float(whole.alpha[middle].min()) > 0.8
    assert torch.allclose(whole.rgb[middle], torch.tensor(0.4), atol=0.08)
    assert 0 < float(mended.confidence.min()) <= float(mended.confidence.max()) < 1


def test_lamps_are_switched_from_a_time_on(world):
    after = done(world, LAMPS | {"state": "brake", "from_s": 0.1})
    (change,) = after.lamps
    assert (change.actor_id, change.state) == ("car", "brake")
    assert (change.first_ns, change.last_ns) == (FRAME_NS, int(TIMES_NS[-1]) + AFTER_NS)
    assert after.scene is world.scene


def test_edits_hold_for_images_taken_before_the_first_frame_and_after_the_last(world):
    (change,) = done(world, {"op": "lamps", "actor": "car", "state": "off"}).lamps
    guest = GUEST | {"speed_mps": 10}
    after = done(world, guest, guest | {"name": "second", "trajectory": "lateral:-3"})
    early_ns, late_ns = -FRAME_NS, int(TIMES_NS[-1]) + FRAME_NS
    assert change.first_ns <= early_ns
    assert change.last_ns >= late_ns
    for track in after.moving[1:]:
        assert track.is_present(early_ns)
        assert track.is_present(late_ns)
        x_m = [float(track.pose_at(time_ns)[0, 3]) for time_ns in (early_ns, 0, late_ns)]
        assert [x_m[0] - x_m[1], x_m[2] - x_m[1]] == pytest.approx([-1, 4], abs=1e-3)


def test_a_guest_that_is_slower_begins_where_it_began(world):
    guest, slower = GUEST | {"speed_mps": 10}, {"op": "retime", "actor": "guest", "speed": 0.5}
    fast, slow = (places(done(world, *ops), "guest") for ops in ((guest,), (guest, slower)))
    assert slow[[0, 2], 0].tolist() == pytest.approx(fast[[0, 1], 0].tolist(), abs=1e-3)


def test_what_lies_behind_the_end_of_the_log_is_not_run_into(world):
    """The wall is 8 m ahead; in a second more the guest would be there."""
    after = done(world, GUEST | {"ahead_m": 2.8, "left_m": 4, "speed_mps": 4})
    thick = MapPoints.concatenate([after.lidar_map.street] * 9)
    walled = replace(after, lidar_map=LidarMap(street=thick, actors={}))
    assert not [one for one in encounters(walled) if one.collision.is_wall]


def test_a_parked_car_whose_lamps_are_switched_has_none_before(standing):
    operation = {"op": "lamps", "actor": "parked", "state": "on", "from_s": 0.1, "until_s": 0.2}
    after = done(standing, operation)
    changes = [(one.state, one.first_ns) for one in after.lamps]
    assert changes == [("off", -AFTER_NS), ("on", FRAME_NS)]
    assert after.parked == ()
    assert torch.allclose(places(after, "parked"), PARKED_POSE[:3, 3].expand(4, 3))
    own = len(standing.rows_of(standing.parked[0]))
    assert len(after.rows_of(after.find("parked"))) == own > 100
    assert not encounters(after)  # it stands where it stood


def test_painters_do_not_see_what_was_recorded_where_somebody_was(world):
    after = done(world, {"op": "remove", "actors": ["car"]})
    seen = masked_observations(after)
    assert seen.tracks == ()
    hidden = torch.stack([view.hidden for view in seen.views])
    assert 0.01 < float(hidden.float().mean()) < 0.5
    builder = ConditionBuilder(after.scene, seen.lidar_map, seen.views)
    source = builder.source(seen.views[1].key)
    covered = seen.views[1].hidden
    shown = after.scene.render(source.camera, source.timestamp_ns).rgb
    assert torch.equal(source.rgb[covered], shown[covered])
    assert float(source.depth_m[covered].max()) == 0


def test_who_is_moved_into_a_wall_is_found(world):
    after = done(world, MOVE | {"trajectory": "lateral:-2.3"})
    thick = after.lidar_map.street
    walled = replace(
        after, lidar_map=LidarMap(street=MapPoints.concatenate([thick] * 9), actors={})
    )
    with pytest.raises(ConfigError, match=r"into a wall: car meets \d+ LiDAR points"):
        refuse_walls(encounters(walled))


@pytest.mark.parametrize(
    ("operation", "complaint"),
    [
        ({"op": "remove", "actors": ["bus"]}, "operation 1, remove: no actor 'bus'"),
        ({"op": "stop", "actor": "car", "at_s": 9}, "at_s 9 s: expected a time of the log, 0 to"),
        (GUEST | {"name": "car"}, "'car' is there already, expected a new name"),
        (LAMPS | {"from_s": 0.2, "until_s": 0.1}, "operation 1, lamps: expected from_s <= until_s"),
        ({"op": "crop", "from_m": 500, "to_m": 600}, "nothing stands from 500 to 600 m"),
        (MOVE | {"trajectory": "follow:bus"}, "operation 1, move: no actor 'bus'"),
    ],
)
def test_what_cannot_be_done_is_said(world, operation, complaint):
    with pytest.raises(ConfigError, match=complaint):
        done(world, operation)


def test_a_file_without_a_car_is_refused():
    empty = round_gaussians(torch.zeros(3, 3), torch.zeros(3, 3), sigma_m=0.1, opacity=0.1)
    with pytest.raises(SceneError, match="nothing opaque"):
        ActorModel.of_gaussians(empty, "car")


def test_a_style_is_read_and_left_to_the_end():
    (style,) = parse_operations([{"op": "style", "prompt": "foggy:0.5+night", "strength": 0.5}], "")
    assert style.mix.text == "foggy:0.25+night:0.5"
    for wrong in ({"prompt": "snow"}, {"prompt": "rain", "visibility_m": 50.0}):
        with pytest.raises(ConfigError):
            parse_operations([{"op": "style", **wrong}], "test")


def test_an_actor_that_lidar_saw_from_one_side_has_points_all_round():
    sides = torch.tensor([-0.9, 0.9])
    means = torch.cartesian_prod(torch.linspace(-2, 2, 9), sides, torch.zeros(1))
    grey = torch.full_like(means, 0.5)
    seen = ActorModel(
        gaussians=round_gaussians(means, grey, sigma_m=0.1),
        points=map_points(means[means[:, 1] > 0], grey[means[:, 1] > 0]),
        size_m=torch.tensor([4.0, 1.8, 1.5]),
        category="car",
    )
    points = seen.with_points_all_round().points
    assert sorted(points.xyz_m[:, 1].sign().tolist()) == [-1.0] * 9 + [1.0] * 9
    assert points.has_colour.all()
