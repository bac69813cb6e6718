"""What an export of a scene holds: the street, its actors with their poses over time, the sky.

Street and sky stand in the world (x forward, y left, z up, metres), each actor in its box frame (x
along the length, y left, z up, origin at the centre). Colours are those of the scene before any
camera's exposure.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.gaussians.model.drawing import (
    camera_from_body,
    draw_gaussians,
    draw_over_sky,
)
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, sh_from_rgb
from lidarpainter_models.gaussians.model.placing import carried_gaussians, joined_gaussians
from lidarpainter_models.gaussians.model.ply_files import write_ply
from lidarpainter_models.gaussians.model.sky import SkyTexture
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.sky_texture import SkyLayout
from lidarpainter_models.metrics.images import psnr_from_error, squared_error


@dataclass(frozen=True, slots=True, kw_only=True)
class Fidelity:
    """How close the images of an exported scene are to ours."""

    psnr_db: float
    """PSNR of all images together; infinite where they are the same."""
    worst_psnr_db: float
    """PSNR of the worst image."""
    num_views: int


def fidelity(
    scene: GaussianScene,
    exported_world: GaussianSet,
    timestamp_ns: int,
    cameras: Sequence[Camera],
    *,
    sky: SkyTexture | None,
) -> Fidelity:
    """Compare at some cameras, all at the time of the export.

    `exported_world` is what others read of it; without a `sky` it is drawn over black.
    """
    errors = []
    for camera in cameras:
        ours = scene.render(camera, timestamp_ns).rgb.clamp(0, 1)
        theirs = world_image(exported_world, camera, sky)
        errors.append(float(squared_error(theirs, ours).double().mean()))
    return Fidelity(
        psnr_db=psnr_from_error(sum(errors) / len(errors)),
        worst_psnr_db=psnr_from_error(max(errors)),
        num_views=len(errors),
    )


def world_image(
    gaussians_world: GaussianSet, camera: Camera, sky: SkyTexture | None
) -> Float[Tensor, "height width 3"]:
    """Gaussians that all stand in the world, over a sky or over black."""
    nobody = torch.zeros(0, 4, 4, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    bodies = camera_from_body(camera.world_from_camera, *nobody)
    if sky is None:
        return draw_gaussians(gaussians_world, bodies, camera).rgb
    return draw_over_sky(gaussians_world, bodies, sky, camera).rgb


FRAME = "x forward, y left, z up at the first frame; metres"
"""The world of a scene, as files say it that have no word of their own for it."""
SKY_RADIUS_M = 1000.0
"""Where Gaussians of the sky stand: a car that drives 100 m sees them turn by 6 degrees."""
SKY_STEP_RAD = math.radians(0.5)
"""Between neighbouring Gaussians of the sky: 2000 for a camera's view, 60 000 for all of it."""
_SKY_OVERLAP = 0.8  # standard deviation in steps: seams stay shut, clouds stay clouds


@dataclass(frozen=True, kw_only=True, eq=False)
class ExportedActor:
    """One actor's Gaussians, in its box frame."""

    actor_id: str
    category: str
    size_m: Float[Tensor, "3"]
    gaussians: GaussianSet


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneContents:
    """A scene in parts, and where the parts are over time."""

    name: str
    street: GaussianSet
    """With the sky, where that was asked for."""
    actors: tuple[ExportedActor, ...]
    timestamps_ns: Int[Tensor, " times"]
    world_from_actor: Float[Tensor, "times actors 4 4"]
    """float64; beyond its boxes an actor stays where it was last seen."""
    is_present: Bool[Tensor, "times actors"]

    @property
    def seconds(self) -> Float[Tensor, " times"]:
        """The times since the first one."""
        return (self.timestamps_ns - self.timestamps_ns[0]).double() * 1e-9

    @property
    def num_gaussians(self) -> int:
        """How many Gaussians the street and all actors have."""
        return len(self.street) + sum(len(actor.gaussians) for actor in self.actors)

    def placed(self, time: int) -> GaussianSet:
        """Everything that is there at the n-th of the times, in the world."""
        there = self.is_present[time].tolist()
        return joined_gaussians(
            [
                self.street,
                *(
                    carried_gaussians(actor.gaussians, pose)
                    for actor, pose, is_there in zip(
                        self.actors, self.world_from_actor[time], there, strict=True
                    )
                    if is_there
                ),
            ]
        )


def write_ply_scene(path: Path, contents: SceneContents, *, time: int = 0) -> None:
    """Write everything that is there at the n-th of the times as one PLY file, in the world.

    Raises:
        WriteError: the disk refuses; nothing is left half-written.
    """
    said = f"{contents.name}: {FRAME}; colours before any camera's exposure"
    write_ply(path, contents.placed(time), [said])


def scene_contents(
    scene: GaussianScene,
    name: str,
    timestamps_ns: Sequence[int],
    *,
    actors: Sequence[str] | None = None,
    with_sky: bool = False,
) -> SceneContents:
    """Take a scene apart.

    Poses are wanted at `timestamps_ns`, ascending; at one time alone, people are bent and lamps
    lit as they are then, else people are at rest, and lamps and the light of actors as on average.
    None takes all actors; `with_sky` shows the sky by far Gaussians.

    Raises:
        SceneError: the scene has no such actor.
    """
    tracks = scene.actors.recorded_tracks
    places = {track.actor_id: place for place, track in enumerate(tracks)}
    wanted = tuple(places) if actors is None else tuple(actors)
    if missing := [one for one in wanted if one not in places]:
        known = ", ".join(sorted(places)[:20]) or "none that moves"
        raise SceneError(f"scene {name} has no actor {missing[0]!r}, it has {known}")
    gaussians = scene.gaussians_at(timestamps_ns[0] if len(timestamps_ns) == 1 else None)
    bodies = _bodies(gaussians, len(tracks) + 1)
    street = bodies[0].append(sky_gaussians(scene.sky, scene)) if with_sky else bodies[0]
    rows = [places[one] for one in wanted]
    poses = [scene.actors.refined_poses(time_ns) for time_ns in timestamps_ns]
    return SceneContents(
        name=name,
        street=street,
        actors=tuple(
            ExportedActor(
                actor_id=tracks[row].actor_id,
                category=tracks[row].category,
                size_m=tracks[row].size_m,
                gaussians=bodies[row + 1],
            )
            for row in rows
        ),
        timestamps_ns=torch.tensor(list(timestamps_ns), dtype=torch.int64),
        world_from_actor=torch.stack([world_from_actor[rows] for world_from_actor, _ in poses]),
        is_present=torch.stack([present[rows] > 0 for _, present in poses]),
    )


def _bodies(gaussians: GaussianSet, count: int) -> list[GaussianSet]:
    """The Gaussians of every body, each as body 0 of its own."""
    order = torch.argsort(gaussians.body_index, stable=True)
    sizes = torch.bincount(gaussians.body_index.long(), minlength=count).tolist()
    return [gaussians.select(rows).of_body(0) for rows in order.split(sizes)]


def sky_gaussians(sky: SkyTexture, scene: GaussianScene) -> GaussianSet:
    """Gaussians on a far sphere that show the sky's texture, around the middle of the drive."""
    layout = sky.layout
    step = max(1, round(SKY_STEP_RAD / layout.texel_rad))
    colours = torch.nn.functional.avg_pool2d(
        sky.rgb.detach().permute(2, 0, 1)[None], step, ceil_mode=True, count_include_pad=False
    )[0].permute(1, 2, 0)
    directions = _texel_directions(layout, step, colours.shape[0], colours.shape[1])
    rgb = colours.flatten(0, 1)
    count = len(rgb)
    centre = scene.cameras.recorded_world_from_camera[:, :3, 3].mean(dim=0)
    flat = torch.tensor([step * layout.texel_rad * _SKY_OVERLAP * SKY_RADIUS_M])
    return GaussianSet(
        means=(centre + directions * SKY_RADIUS_M).float(),
        rotation_wxyz=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scale=flat.log().repeat(count, 3),
        opacity_logit=torch.full((count,), 6.0),
        sh_dc=sh_from_rgb(rgb.clamp(0, 1)),
        sh_rest=torch.zeros(count, scene.gaussians.sh_rest.shape[1], 3),
        body_index=torch.zeros(count, dtype=torch.int32),
    )


def _texel_directions(
    layout: SkyLayout, step: int, rows: int, columns: int
) -> Float[Tensor, "texels 3"]:
    """World directions of blocks of texels, row by row."""
    row = (torch.arange(rows, dtype=torch.float64) + 0.5) * step
    column = (torch.arange(columns, dtype=torch.float64) + 0.5) * step
    elevation = (layout.elevation_top_rad - row * layout.texel_rad)[:, None]
    azimuth = (layout.azimuth_left_rad - column * layout.texel_rad)[None, :]
    flat = elevation.cos()
    directions = [flat * azimuth.cos(), flat * azimuth.sin(), elevation.sin() + 0 * azimuth]
    return torch.stack(directions, dim=-1).flatten(0, 1)
