"""A road whose every height and line is known: what ground, lanes, map and drives are tested on.

Straight or bent, it falls to its right edge and rises along; a kerb, a car, a wall stand on it.
"""

from functools import cache

import numpy as np
import torch
from gaussian_world import bare_points

from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.lidar.ground_surface import ground_surface
from lidarpainter_models.lidar.road_lanes import driven_line, driven_road_lanes
from lidarpainter_models.lidar.surroundings import Surroundings
from lidarpainter_models.scenes.tracks import ActorTrack

LENGTH_M, STEP_NS, SPEED_MPS = 40.0, 100_000_000, 8.0
ORIGIN_M = 0.3
"""Of the recording car, above the road."""
FALL, RISE = 0.02, 0.01
KERB_D_M, KERB_M = -5.0, 0.15


def bent(s_m, d_m, curvature_per_m=0.0):
    """World x, y of road coordinates beside an arc from the origin along x."""
    s_m, d_m = np.broadcast_arrays(np.asarray(s_m, float), np.asarray(d_m, float))
    if curvature_per_m == 0:
        return np.stack([s_m, d_m], axis=-1)
    turn = s_m * curvature_per_m
    radius = 1 / curvature_per_m - d_m
    return np.stack([radius * np.sin(turn), 1 / curvature_per_m - radius * np.cos(turn)], axis=-1)


def height_m(s_m, d_m):
    """Of the ground; a kerb runs along its right edge."""
    return FALL * d_m + RISE * s_m + KERB_M * (d_m < KERB_D_M)


def road_path(curvature_per_m=0.0):
    """The recording car in the middle of its lane."""
    s_m = np.arange(0, LENGTH_M + 0.1, SPEED_MPS * 0.1)
    poses = np.tile(np.eye(4), (len(s_m), 1, 1))
    turn = s_m * curvature_per_m
    poses[:, 0, 0], poses[:, 1, 0] = np.cos(turn), np.sin(turn)
    poses[:, 0, 1], poses[:, 1, 1] = -np.sin(turn), np.cos(turn)
    poses[:, :2, 3] = bent(s_m, 0.0, curvature_per_m)
    poses[:, 2, 3] = height_m(s_m, 0.0) + ORIGIN_M
    times_ns = torch.arange(len(s_m)) * STEP_NS + 10**15
    return DrivenPath(timestamps_ns=times_ns, world_from_body=torch.from_numpy(poses))


def road_points(count, *, curvature_per_m=0.0, seed=0, noise_m=0.01, below_car=True):
    """LiDAR points on the ground, on a parked car's roof and sides and on a wall, world frame."""
    rng = np.random.default_rng(seed)
    s, d = rng.uniform(-45, LENGTH_M + 45, count), rng.uniform(-12, 12, count)
    z = height_m(s, d) + noise_m * rng.standard_normal(count)
    on_car = (np.abs(s - 20) < 2.2) & (np.abs(d + 3.2) < 0.9)
    z[on_car] = height_m(s, d)[on_car] + rng.uniform(0.5, 1.5, on_car.sum())
    beyond = d > 11
    z[beyond] += rng.uniform(0, 5, beyond.sum())
    kept = below_car | (np.abs(d) > 1.0) | (s < 0) | (s > LENGTH_M)
    xyz_m = np.column_stack([bent(s, d, curvature_per_m), z])[kept]
    return xyz_m, np.stack([s, d], axis=1)[kept], (on_car | beyond)[kept]


def map_points(xyz_m):
    """Points as a LiDAR map has them."""
    return bare_points(torch.from_numpy(xyz_m).float())


def marking_places(lines, curvature_per_m=0.0, seed=1):
    """World x and y of paint on lines: d by whether solid; broken ones show 3 m of 12."""
    rng = np.random.default_rng(seed)
    found = []
    for d_m, is_solid in lines.items():
        s = rng.uniform(-12, LENGTH_M + 12, 4000)
        s = s if is_solid else s[np.mod(s, 12) < 3]
        found.append(bent(s, d_m + rng.uniform(-0.06, 0.06, len(s)), curvature_per_m))
    return np.concatenate(found)


def moving_track(actor_id, s_m, d_m, *, times_ns, yaw_rad=0.0, is_moving=True):
    """An actor of a car's size at places along a straight road."""
    poses = np.tile(np.eye(4), (len(times_ns), 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(yaw_rad)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(yaw_rad), -np.sin(yaw_rad)
    poses[:, 0, 3], poses[:, 1, 3] = s_m, d_m
    poses[:, 2, 3] = height_m(np.asarray(s_m), np.asarray(d_m)) + 0.75
    return ActorTrack(
        actor_id=actor_id,
        category="Car",
        is_moving=is_moving,
        size_m=torch.tensor([4.4, 1.8, 1.5]),
        frame_indices=torch.arange(len(times_ns)),
        timestamps_ns=times_ns,
        world_from_box=torch.from_numpy(poses),
        num_points=torch.full((len(times_ns),), 100),
    )


@cache
def street_and_ground(curvature_per_m, count):
    """Points of the street and the ground that is found in them; made once."""
    street = map_points(road_points(count, curvature_per_m=curvature_per_m)[0])
    return street, ground_surface(street, road_path(curvature_per_m))


def road_surroundings(lines=None, *, curvature_per_m=0.0, tracks=(), count=120_000):
    """Ground, street and lanes of the road."""
    path = road_path(curvature_per_m)
    street, ground = street_and_ground(curvature_per_m, count)
    road = driven_road_lanes(
        driven_line(path, ground),
        marking_places(lines or {-1.75: True, 1.75: False}, curvature_per_m),
        ground,
        tracks,
        path_length_m=LENGTH_M,
        trusted_m=(2.0, 2.0),
    )
    return Surroundings(ground=ground, street=street, road=road)
