"""What is in the way of a path is found, and when."""

import torch
from gaussian_world import bare_points as street

from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.lidar.collisions import MovingBody, find_collisions
from lidarpainter_models.scenes.tracks import ActorTrack

SECOND_NS = 1_000_000_000
CAR_M = torch.tensor([4.0, 2.0, 1.5])


def wall(x_m, *, low_m=0.0, high_m=3.0):
    """Two hundred points across the road."""
    generator = torch.Generator().manual_seed(0)
    spread = torch.rand(200, 2, generator=generator)
    y_m = 4 * spread[:, 0] - 2
    return torch.stack([torch.full_like(y_m, x_m), y_m, low_m + (high_m - low_m) * spread[:, 1]], 1)


def driving(actor_id="car", *, y_m=0.0, yaw_rad=0.0, speed_mps=10.0, seconds=3):
    tangents = torch.zeros(seconds, 6, dtype=torch.float64)
    tangents[:, 2] = yaw_rad
    tangents[:, 3] = speed_mps * torch.arange(seconds)
    tangents[:, 4], tangents[:, 5] = y_m, 0.75
    return ActorTrack(
        actor_id=actor_id,
        category="car",
        is_moving=True,
        size_m=CAR_M,
        frame_indices=torch.arange(seconds),
        timestamps_ns=torch.arange(seconds) * SECOND_NS,
        world_from_box=rigid_from_tangent(tangents),
        num_points=torch.ones(seconds).long(),
    )


def test_a_wall_is_found_when_the_car_is_in_it_and_the_road_is_none():
    body = MovingBody.car(driving())
    (found,) = find_collisions(body, street(wall(10.0).repeat(4, 1)), [], start_ns=0)
    assert found.is_wall
    assert (found.obstacle, found.from_s, found.to_s) == ("points", 1.0, 1.0)
    assert str(found).endswith("LiDAR points from 1.0 to 1.0 s")
    road = street(wall(10.0, high_m=0.2).repeat(9, 1))
    assert find_collisions(body, road, [], start_ns=0) == []
    beside = street(wall(10.0).repeat(9, 1) + torch.tensor([0.0, 4, 0]))
    assert find_collisions(body, beside, [], start_ns=0) == []
    assert find_collisions(body, street(torch.zeros(0, 3)), [], start_ns=0) == []


def test_a_few_stray_points_are_no_wall():
    body = MovingBody.car(driving())
    stray = torch.tensor([10.0, 0.0, 1.0]).expand(50, 3)
    assert find_collisions(body, street(stray), [], start_ns=0) == []
    assert find_collisions(body, street(stray.repeat(4, 1)), [], start_ns=0)[0].num_points == 200


def test_actors_touch_where_their_outlines_do():
    body = MovingBody.car(driving(speed_mps=10.0))
    others = [
        driving("in the way", speed_mps=0.0),
        driving("beside", y_m=2.1, speed_mps=10.0),
        driving("slanted", y_m=2.1, yaw_rad=0.8, speed_mps=10.0),
        driving("above", speed_mps=10.0),
    ]
    others[3].world_from_box[:, 2, 3] += 5
    found = find_collisions(body, street(torch.zeros(0, 3)), others, start_ns=0)
    assert [(one.obstacle, one.from_s, one.to_s) for one in found] == [
        ("in the way", 0.0, 0.0),
        ("slanted", 0.0, 2.0),
    ]
    assert not found[0].is_wall


def test_a_camera_needs_half_a_metre():
    poses = rigid_from_tangent(torch.zeros(2, 6, dtype=torch.float64))
    poses[1, 0, 3] = 9.6
    camera = MovingBody.camera(poses, torch.tensor([0, SECOND_NS]))
    (found,) = find_collisions(camera, street(wall(10.0, low_m=-1).repeat(9, 1)), [], start_ns=0)
    assert found.from_s == 1.0
