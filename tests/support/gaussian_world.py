"""A tiny world made of Gaussians, so that a fit can in principle be perfect.

A rough, speckled wall 8 m ahead, a speckled car in front of it that drives to the left, and a
plain sky above.
"""

from dataclasses import dataclass, replace

import torch

from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.corrections import CameraCorrections, ExposureCorrections
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, sh_from_rgb
from lidarpainter_models.gaussians.model.sky import SkyTexture, sky_layout
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rigid_from_rotation, rotation_from_vector
from lidarpainter_models.lidar.lidar_map import LidarMap, MapPoints
from lidarpainter_models.observations.views import SceneObservations, TrainingView
from lidarpainter_models.scenes.driving_scene import ActorTrack

WIDTH_PX, HEIGHT_PX = 64, 48
LOOK_FORWARD = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
FRAME_NS = 100_000_000
SKY_RGB = torch.tensor([0.6, 0.7, 0.9])
CAR_SIZE_M = torch.tensor([2.0, 1.0, 1.0])


def camera_at(x_m, *, width_px=WIDTH_PX, height_px=HEIGHT_PX):
    """A camera that looks along world x."""
    pose = rigid_from_rotation(LOOK_FORWARD, torch.tensor([x_m, 0.0, 1.0])).double()
    return Camera.centred(pose, 0.8 * width_px, width_px=width_px, height_px=height_px)


def turned_camera(yaw_rad):
    """A camera at the origin that looks along world x, turned to the left."""
    base = camera_at(0.0)
    turn = rotation_from_vector(torch.tensor([0.0, 0.0, yaw_rad]).double())
    return base.at(
        rigid_from_rotation(turn @ base.world_from_camera[:3, :3], torch.zeros(3).double())
    )


def car_track(num_frames):
    """Drives to the left (+y) at 1 m per frame."""
    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    poses = [
        rigid_from_rotation(turn, torch.tensor([6.0, -2.0 + frame, 0.6])).double()
        for frame in range(num_frames)
    ]
    return ActorTrack(
        actor_id="car",
        category="Car",
        is_moving=True,
        size_m=CAR_SIZE_M,
        frame_indices=torch.arange(num_frames),
        timestamps_ns=torch.arange(num_frames) * FRAME_NS,
        world_from_box=torch.stack(poses),
        num_points=torch.full((num_frames,), 50),
    )


def round_gaussians(means, rgb, *, sigma_m, body=0, opacity=0.9, sh_degree=1):
    """Spheres of one size."""
    count = means.shape[0]
    return GaussianSet(
        means=means,
        rotation_wxyz=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        log_scale=torch.full((count, 3), sigma_m).log(),
        opacity_logit=torch.logit(torch.full((count,), opacity)),
        sh_dc=sh_from_rgb(rgb),
        sh_rest=torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
        body_index=torch.full((count,), body, dtype=torch.int32),
    )


def scene_of(gaussians, cameras, tracks=(), *, sky_rgb=SKY_RGB, timestamps_ns=None):
    """A scene with nothing corrected, the cameras being its training views."""
    times = torch.arange(len(cameras)) * FRAME_NS if timestamps_ns is None else timestamps_ns
    return GaussianScene(
        gaussians=gaussians,
        sky=SkyTexture.constant(sky_layout(cameras), sky_rgb),
        cameras=CameraCorrections.none(
            [(frame, "front") for frame in range(len(cameras))],
            times,
            torch.stack([camera.world_from_camera for camera in cameras]),
        ),
        actors=Actors.uncorrected(tracks, times),
        exposure=ExposureCorrections.none(["front"], [0]),
    )


def scene_trained_on(views):
    """One Gaussian ahead of the given recorded views, which are the scene's training views."""
    ahead = round_gaussians(torch.tensor([[8.0, 0.0, 1.0]]), torch.full((1, 3), 0.5), sigma_m=0.5)
    scene = scene_of(ahead, [view.camera for view in views])
    return replace(scene, cameras=cameras_of(views))


def cameras_of(views):
    """The cameras of training views, not corrected."""
    return CameraCorrections.none(
        [view.key for view in views],
        torch.tensor([view.timestamp_ns for view in views]),
        torch.stack([view.camera.world_from_camera for view in views]),
    )


def training_view(camera, *, frame=0, **shown):
    """A black view of a frame, without sky and LiDAR if nothing else is said."""
    size = camera.height_px, camera.width_px
    plain = {
        "key": (frame, "front"),
        "timestamp_ns": frame * FRAME_NS,
        "rgb_u8": torch.zeros(*size, 3, dtype=torch.uint8),
        "sky_mask": torch.zeros(size, dtype=torch.bool),
        "lidar_depth_m": torch.zeros(size),
    }
    return TrainingView(camera=camera, **(plain | shown))


def bare_points(xyz_m, *, range_m=1.0):
    """Points without colour, of frame 0."""
    nothing = torch.zeros(len(xyz_m), dtype=torch.int64)
    ranges_m = torch.full((len(xyz_m),), range_m)
    return MapPoints.uncoloured(
        xyz_m=xyz_m, frame_index=nothing, timestamp_ns=nothing, range_m=ranges_m
    )


def map_points(xyz_m, rgb):
    """Coloured points of frame 0."""
    count = xyz_m.shape[0]
    return MapPoints(
        xyz_m=xyz_m,
        rgb_u8=(rgb.clamp(0, 1) * 255).to(torch.uint8),
        has_colour=torch.ones(count, dtype=torch.bool),
        frame_index=torch.zeros(count, dtype=torch.int64),
        timestamp_ns=torch.zeros(count, dtype=torch.int64),
        range_m=xyz_m.norm(dim=1),
    )


@dataclass(frozen=True, kw_only=True)
class World:
    """A scene, and what its cameras and LiDAR saw of it."""

    scene: GaussianScene
    observations: SceneObservations


def observe(scene, cameras, wall, car):
    """Images, depth and sky of a scene from its cameras, and its points as the LiDAR map."""
    views = []
    for frame, camera in enumerate(cameras):
        render = scene.render(camera, frame * FRAME_NS)
        views.append(
            training_view(
                camera,
                frame=frame,
                rgb_u8=(render.rgb.clamp(0, 1) * 255).round().to(torch.uint8),
                sky_mask=render.alpha < 0.05,
                lidar_depth_m=torch.where(render.alpha > 0.9, render.depth_m, 0.0),
            )
        )
    lidar_map = LidarMap(street=wall, actors={"car": car})
    return SceneObservations(
        views=tuple(views), lidar_map=lidar_map, tracks=scene.actors.recorded_tracks
    )


def build_world():
    """Four views of a wall and a car, 0.3 m apart."""
    generator = torch.Generator().manual_seed(7)
    y, z = torch.meshgrid(torch.linspace(-6, 6, 40), torch.linspace(-4, 3, 24), indexing="ij")
    # rough, because on a flat wall the drawing order would flip with the slightest turn
    relief_m = 0.6 * torch.rand(y.shape, generator=generator)
    wall_m = torch.stack([8.0 + relief_m, y, z], dim=-1).flatten(0, 1)
    wall_rgb = torch.rand(wall_m.shape[0], 3, generator=generator)
    car_m = (torch.rand(120, 3, generator=generator) - 0.5) * CAR_SIZE_M
    car_rgb = torch.rand(120, 3, generator=generator) * 0.5
    gaussians = round_gaussians(wall_m, wall_rgb, sigma_m=0.17).append(
        round_gaussians(car_m, car_rgb, sigma_m=0.1, body=1)
    )
    cameras = [camera_at(0.3 * frame) for frame in range(4)]
    scene = scene_of(gaussians, cameras, [car_track(4)])
    observations = observe(scene, cameras, map_points(wall_m, wall_rgb), map_points(car_m, car_rgb))
    return World(scene=scene, observations=observations)
