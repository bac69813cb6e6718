"""The synthetic street: exact images, depth, classes and LiDAR at any pose and time.

World: x forward, y left, z up, origin at the first ego pose, which stands on the ground. Camera: x
right, y down, z forward. Times are nanoseconds; frame i is taken at `timestamps_ns[i]`, the middle
of its sweep.
"""

from collections.abc import Mapping
from copy import copy
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.records import Distortion, SweepPoints
from lidarpainter_models.synthetic.config import RigCamera, SyntheticStreetConfig
from lidarpainter_models.synthetic.lidar_sensor import (
    beam_inclinations_rad,
    firings,
    intensities,
    returns_mask,
)
from lidarpainter_models.synthetic.raytracing.scene_arrays import InstanceArrays, ViewArrays
from lidarpainter_models.synthetic.textures.surfaces import StreetClass
from lidarpainter_models.synthetic.truth import ActorState, LensState, SimulatedSweep, TrueImage
from lidarpainter_models.synthetic.world.city import ActorChange, City, build_city

START_NS = 1_700_000_000_000_000_000
GENERATOR = "lidarpainter synthetic street"
WORLD_VERSION = 2
"""Raise it whenever equal settings would give another world."""


_city = lru_cache(maxsize=1)(build_city)
"""The last one is kept: whoever records a street judges it later."""


class SyntheticStreet:
    """A street drawn from a seed. Building one takes some seconds; rendering is then cheap."""

    def __init__(self, config: SyntheticStreetConfig) -> None:
        self.config = config
        self._city: City = _city(**self._world())

    def _world(self) -> dict[str, Any]:
        """What of the settings decides what stands and moves in the street."""
        names = ("seed", "speed_mps", "are_people_walking", "are_lamps_switching")
        return {name: getattr(self.config, name) for name in names}

    def changed(self, change: ActorChange) -> "SyntheticStreet":
        """The same street with other actors in it: the exact truth of an edit."""
        other = copy(self)
        other._city = build_city(**self._world(), change=change)
        return other

    @classmethod
    def from_manifest(cls, manifest: Mapping[str, Any]) -> "SyntheticStreet":
        """Rebuild the world a stored synthetic scene was recorded in.

        Raises:
            SceneError: the scene is not synthetic, or another version of the code drew it.
        """
        generator = manifest.get("generator")
        if not isinstance(generator, Mapping) or generator.get("name") != GENERATOR:
            raise SceneError(
                f"scene {manifest.get('dataset')}/{manifest.get('sequence')} was not generated "
                f"here, expected 'generator' with the name {GENERATOR!r} in its manifest"
            )
        if generator.get("world_version") != WORLD_VERSION:
            raise SceneError(
                f"the scene was drawn by version {generator.get('world_version')} of the street, "
                f"expected {WORLD_VERSION}: write it again"
            )
        return cls(SyntheticStreetConfig.from_dict(generator["config"]))

    def to_generator(self) -> dict[str, Any]:
        """What `from_manifest` needs, JSON-able."""
        return {"name": GENERATOR, "world_version": WORLD_VERSION, "config": self.config.to_dict()}

    @cached_property
    def timestamps_ns(self) -> tuple[int, ...]:
        """Middle of each frame's sweep, when its images are taken."""
        step_ns = round(self.config.frame_interval_s * 1e9)
        return tuple(START_NS + index * step_ns for index in range(self.config.num_frames))

    @property
    def city(self) -> City:
        """All that was drawn."""
        return self._city

    @property
    def num_actors(self) -> int:
        """How many boxed things there are."""
        return len(self._city.actors)

    def world_from_ego(self, timestamp_ns: int) -> Float[Tensor, "4 4"]:
        """The true pose of the recording car, float64."""
        return torch.from_numpy(self._city.ego.world_from_ego(_seconds(timestamp_ns))[0])

    def camera(self, name: str, timestamp_ns: int) -> Camera:
        """A camera of the rig at full size, where it truly is at a time.

        Raises:
            ConfigError: the rig has no such camera.
        """
        rig = self._rig(name)
        width_px, height_px = self.config.width_px, self.config.height_px
        pose = self.world_from_ego(timestamp_ns) @ ego_from_camera(rig)
        focal_px = rig.focal_per_width * width_px
        return Camera.centred(pose, focal_px, width_px=width_px, height_px=height_px)

    def distortion(self, name: str) -> Distortion:  # noqa: ARG002
        """How the lens of a camera of the rig departs from `camera`: not at all.

        A street of other lenses overrides it, and `camera` and `render_recorded` with it.
        """
        return Distortion()

    def actors(self, timestamp_ns: int) -> list[ActorState]:
        """Every actor's box at a time, in the order of `actor_index`."""
        line, time_s = self._city.plan.line, _seconds(timestamp_ns)
        return [
            ActorState(
                actor_id=actor.actor_id,
                category=actor.category,
                is_moving=actor.is_moving,
                size_m=(float(actor.size_m[0]), float(actor.size_m[1]), float(actor.size_m[2])),
                world_from_box=torch.from_numpy(actor.world_from_box(line, time_s)[0]),
            )
            for actor in self._city.actors
        ]

    def lamps(self, timestamp_ns: int) -> list[LensState]:
        """Every lens of a lamp that switches at a time: those of signals, then those of cars.

        There are none where the settings let no lamp switch.
        """
        city = self._city
        is_lit = city.lamps.is_lit(_seconds(timestamp_ns))[0]
        lenses = [(-1, lens) for lens in city.lamps.standing]
        lenses += [
            (index, lens) for index, actor in enumerate(city.actors) for lens in actor.lenses
        ]
        return [
            LensState(
                actor_index=index,
                centre_m=torch.from_numpy(lens.centre_m),
                size_m=torch.from_numpy(lens.size_m),
                is_lit=bool(is_lit[lens.lamp]),
            )
            for index, lens in lenses
        ]

    def _rig(self, name: str) -> RigCamera:
        rig = next((rig for rig in self.config.cameras if rig.name == name), None)
        if rig is None:
            names = ", ".join(rig.name for rig in self.config.cameras)
            raise ConfigError(f"the street has no camera {name!r} (it has {names})")
        return rig

    def render(self, camera: Camera, timestamp_ns: int) -> TrueImage:
        """The true image of any pinhole camera at any time, all rows of it at once."""
        pose = camera.world_from_camera[None, :3].to(torch.float64).contiguous().numpy()
        return self._traced(camera, pose, _seconds(timestamp_ns))

    def render_recorded(self, name: str, timestamp_ns: int) -> TrueImage:
        """What a camera of the rig sees around a time, read row by row if it does.

        Raises:
            ConfigError: the rig has no such camera.
        """
        camera, rig = self.camera(name, timestamp_ns), self._rig(name)
        if rig.readout_s == 0:
            return self.render(camera, timestamp_ns)
        share = (np.arange(camera.height_px) + 0.5) / camera.height_px - 0.5
        time_s = _seconds(timestamp_ns) + share * rig.readout_s
        poses = self._city.ego.world_from_ego(time_s) @ ego_from_camera(rig).numpy()
        return self._traced(camera, np.ascontiguousarray(poses[:, :3]), time_s)

    def _traced(self, camera: Camera, poses: np.ndarray, time_s: np.ndarray) -> TrueImage:
        """An image at one pose and time, or with one of each for every row."""
        from lidarpainter_models.synthetic.raytracing.render import render_image  # numba

        view = ViewArrays(
            world_from_camera=poses,
            intrinsics=np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px], float),
            offsets=sample_offsets(self.config.samples_per_axis),
            footprint_px=1.0 / self.config.samples_per_axis,
        )
        rgb, depth_m, semantics, actor_index = render_image(
            self._city.arrays, self._instances(time_s), view, camera.height_px, camera.width_px
        )
        return TrueImage(
            rgb=torch.from_numpy(rgb),
            depth_m=torch.from_numpy(depth_m),
            semantics=torch.from_numpy(semantics),
            actor_index=torch.from_numpy(actor_index),
        )

    def sweep(self, frame_index: int) -> SimulatedSweep:
        """One turn of the LiDAR, every ray cast at its own time and stored in the world."""
        from lidarpainter_models.synthetic.raytracing.lidar import cast_sweep  # numba

        config, lidar = self.config, self.config.lidar
        timestamp_ns = self.timestamps_ns[frame_index]
        offset_s, azimuth_rad = firings(lidar, config.frame_interval_s)
        time_s = _seconds(timestamp_ns) + offset_s
        ego_from_lidar = np.eye(4)
        ego_from_lidar[2, 3] = lidar.up_m
        poses = self._city.ego.world_from_ego(time_s) @ ego_from_lidar
        inclination = beam_inclinations_rad(lidar.beams)
        range_m, surface, label = cast_sweep(
            self._city.arrays,
            self._instances(time_s),
            np.ascontiguousarray(poses[:, :3]),
            azimuth_rad,
            inclination,
            lidar.max_range_m,
        )
        rng = np.random.default_rng([config.seed, frame_index, 64])
        is_kept = returns_mask(range_m, surface, lidar, rng)
        intensity = intensities(surface, rng)[is_kept]
        noise_m = lidar.range_noise_m * rng.standard_normal(range_m.shape)
        flat = np.cos(inclination)[None, :]
        azimuth = azimuth_rad[:, None]
        up = np.broadcast_to(np.sin(inclination)[None, :], range_m.shape)
        rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up], axis=-1)
        column, beam = np.nonzero(is_kept)
        reach = (range_m + noise_m)[is_kept]
        world = np.einsum("nij,nj->ni", poses[column, :3, :3], rays[is_kept] * reach[:, None])
        world += poses[column, :3, 3]
        middle = self._city.ego.world_from_ego(_seconds(timestamp_ns))[0] @ ego_from_lidar
        return SimulatedSweep(
            timestamp_ns=timestamp_ns,
            world_from_lidar=torch.from_numpy(middle),
            points=SweepPoints(
                xyz_m=torch.from_numpy(world.astype(np.float32)),
                intensity=torch.from_numpy(intensity),
                time_offset_ns=torch.from_numpy(np.rint(offset_s[column] * 1e9).astype(np.int64)),
                ring=torch.from_numpy(beam.astype(np.int32)),
                return_index=torch.zeros(column.size, dtype=torch.int32),
                lidar=torch.zeros(column.size, dtype=torch.int32),
            ),
            semantics=torch.from_numpy(label[..., 0][is_kept]),
            actor_index=torch.from_numpy(label[..., 1][is_kept]),
        )

    def instances(self, timestamp_ns: int) -> InstanceArrays:
        """Where everything that moves is at one time, and which lamps are on."""
        return self._instances(_seconds(timestamp_ns))

    def _instances(self, time_s: np.ndarray) -> InstanceArrays:
        """Where everything that moves is at given times, and which lamps are on."""
        city = self._city
        moving = [actor for actor in city.actors if actor.is_moving]
        poses = np.stack([actor.world_from_box(city.plan.line, time_s) for actor in moving], 1)
        vehicles = [actor for actor in city.actors if actor.category != "pedestrian"]
        contact = np.empty((time_s.size, len(vehicles), 6))
        for index, actor in enumerate(vehicles):
            pose = actor.world_from_box(city.plan.line, time_s)
            contact[:, index, 0:2] = pose[:, :2, 3]
            contact[:, index, 2:4] = pose[:, :2, 0]
            contact[:, index, 4:6] = actor.size_m[:2] / 2
        postures = np.stack([actor.posture(time_s) for actor in moving])
        return InstanceArrays(
            roots=np.take_along_axis(city.roots, postures, axis=1).T.copy(),
            radius_m=city.radius_m,
            world_from_box=np.ascontiguousarray(poses[:, :, :3]),
            contact=contact,
            is_lit=city.lamps.is_lit(time_s),
        )


def ego_from_camera(rig: RigCamera) -> Float[Tensor, "4 4"]:
    """Pose of a camera of the rig in the ego frame, float64."""
    cosine, sine = np.cos(rig.yaw_rad), np.sin(rig.yaw_rad)
    pose = np.eye(4)
    pose[:3, 0] = sine, -cosine, 0.0
    pose[:3, 1] = 0.0, 0.0, -1.0
    pose[:3, 2] = cosine, sine, 0.0
    pose[:3, 3] = rig.forward_m, rig.left_m, rig.up_m
    return torch.from_numpy(pose)


def sample_offsets(samples_per_axis: int) -> np.ndarray:
    """Places in a pixel, symmetric about its centre; four are turned so that no two share a line.

    Returns:
        float64 (samples, 2), in 0..1.
    """
    if samples_per_axis == 2:
        return np.array([[0.375, 0.125], [0.875, 0.375], [0.125, 0.625], [0.625, 0.875]])
    places = (np.arange(samples_per_axis) + 0.5) / samples_per_axis
    return np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)


def _seconds(timestamp_ns: int) -> np.ndarray:
    """Time since the first frame, (1)."""
    return np.array([(timestamp_ns - START_NS) / 1e9])


SEMANTIC_NAMES = {int(kind): kind.name.lower() for kind in StreetClass}
