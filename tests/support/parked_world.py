"""A red car parked on a grey road before a camera that creeps ahead.

Everything is made of Gaussians; `clip` gives it as a log would that began elsewhere, with boxes
drawn anew and another exposure.
"""

from dataclasses import replace

import torch
from gaussian_world import FRAME_NS, build_world, camera_at, map_points, round_gaussians, scene_of

from lidarpainter_models.assets.extraction import AssetSource
from lidarpainter_models.assets.sighted_actors import RecordedLook, sighted_actors
from lidarpainter_models.editing.motions import LogTimes
from lidarpainter_models.editing.worlds import EditedWorld
from lidarpainter_models.gaussians.model.placing import carried_gaussians
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.trajectory_parts import headed
from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_tangent
from lidarpainter_models.lidar.lidar_map import LidarMap

NUM_FRAMES = 4
GROUND_M = -0.1
PARKED = "parked-7"
SIZE_M = torch.tensor([3.0, 1.6, 1.2])
RED = torch.tensor([0.5, 0.1, 0.1])


def clip(*, begins_m=0.0, drawn_m=0.0, exposure=1.0):
    """What is published of a log that begins so many metres ahead."""
    world = _world(begins_m, drawn_m, exposure)
    looks = []
    for frame in range(NUM_FRAMES):
        camera = camera_at(0.3 * frame)
        truth = world.fitted.render(camera, frame * FRAME_NS).rgb.clamp(0, 1)
        looks.append(
            RecordedLook(
                camera=camera,
                camera_name="front",
                timestamp_ns=frame * FRAME_NS,
                is_seen=True,
                truth_rgb=truth.clone,
            )
        )
    global_from_world = torch.eye(4, dtype=torch.float64)
    global_from_world[0, 3] = 1e6 + begins_m
    return AssetSource(
        world=world,
        sighted=sighted_actors(world, looks, lambda _done, _total: None),
        judged_on="training",
        global_from_world=global_from_world,
    )


def _world(begins_m, drawn_m, exposure):
    xy = torch.cartesian_prod(torch.arange(2, 14, 0.1), torch.arange(-6, 6, 0.1))
    road_m = torch.cat([xy, torch.full((len(xy), 1), GROUND_M)], dim=1)
    road_rgb = torch.full((len(road_m), 3), 0.3)
    random = torch.Generator().manual_seed(0)
    inside = (torch.rand(600, 3, generator=random) - 0.5) * SIZE_M * 0.95
    stands = headed(torch.tensor([[7.0, 1.8, 0.55]]).double(), torch.tensor([0.2]).double())[0]
    car_m = inside @ stands[:3, :3].T.float() + stands[:3, 3].float()
    car_rgb = RED * (0.5 + torch.rand(600, 1, generator=random))
    points_m = torch.cat([road_m, car_m])
    points_rgb = torch.cat([road_rgb, car_rgb]) * exposure
    sigmas = ((road_m, road_rgb, 0.08), (car_m, car_rgb, 0.1))
    road, car = (round_gaussians(xyz, rgb * exposure, sigma_m=sigma) for xyz, rgb, sigma in sigmas)
    shift = torch.eye(4, dtype=torch.float64)
    shift[0, 3] = begins_m
    carried = carried_gaussians(road.append(car), invert_rigid(shift))
    cameras = [camera_at(0.3 * frame) for frame in range(NUM_FRAMES)]
    scene = scene_of(carried, cameras, ())
    jitter = rigid_from_tangent(
        torch.tensor([0, 0, 0.1 * drawn_m, drawn_m, drawn_m / 2, 0]).double()
    )
    box = invert_rigid(shift) @ stands @ jitter
    parked = replace(
        build_world().scene.tracks[0],
        actor_id=PARKED,
        is_moving=False,
        size_m=SIZE_M,
        world_from_box=box.expand(NUM_FRAMES, 4, 4),
    )
    tangents = torch.zeros(NUM_FRAMES, 6, dtype=torch.float64)
    tangents[:, 3] = 0.3 * torch.arange(NUM_FRAMES)
    times_ns = torch.arange(NUM_FRAMES) * FRAME_NS
    ego = DrivenPath(timestamps_ns=times_ns, world_from_body=rigid_from_tangent(tangents))
    street = map_points(points_m - torch.tensor([begins_m, 0, 0]), points_rgb)
    return EditedWorld(
        scene=scene,
        fitted=scene,
        lidar_map=LidarMap(street=street, actors={}),
        views=(),
        parked=(parked,),
        log=LogTimes(ego=ego),
    )
