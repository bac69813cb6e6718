"""What is written of a followed path: images, depth, who is where, films, pairs side by side."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import pad

from lidarpainter_models.conditioning.followed_paths import FollowedPath, ShownMoment, image_record
from lidarpainter_models.evaluation.view_confidence import Calibration
from lidarpainter_models.export.images import write_depth_png, write_index_png, write_png
from lidarpainter_models.export.videos import images_per_second, video_file
from lidarpainter_models.export.view_requests import RECORDING, ViewKinds
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.instance_images import SKY, STREET, instance_image
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.observations.image_shrinking import shrink_image
from lidarpainter_models.scenes.records import RecordedView

UNPAINTED_FOLDER = "unpainted"
MOST_AHEAD_DEG = 80.0
"""Cameras that look farther aside stand in the lower row: of the rigs that readers know, the front
ring of three stands above."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Delivery:
    """What is written of every view."""

    kinds: ViewKinds
    calibration: Calibration
    """Turns evidence into confidence."""
    beside: str | GaussianScene | None = None
    """What stands to the left in films and in `beside/`, above in a film of all cameras: the
    recording, the render before it was painted, or another scene of the same log."""


def recorded_image(
    path: FollowedPath, camera: Camera, view: RecordedView
) -> Float[Tensor, "height width 3"]:
    """What was recorded at a moment, at the size of a camera; in [0, 1]."""
    return recorded_u8(path, camera, view).float() / 255


def recorded_u8(
    path: FollowedPath, camera: Camera, view: RecordedView
) -> UInt8[Tensor, "height width 3"]:
    """What was recorded at a moment, at the size of a camera, in bytes."""
    size = {"width_px": camera.width_px, "height_px": camera.height_px}
    return shrink_image(path.recorded.read_image(view), **size)


def write_views(
    paths: Sequence[FollowedPath],
    folders: Sequence[Path],
    delivery: Delivery,
    *,
    films: Sequence[Path] = (),
    together: Path | None = None,
    advanced: Callable[[], None],
) -> tuple[list[list[dict[str, Any]]], float]:
    """Write everything that is wanted of the paths of a rig, moment by moment.

    Args:
        paths: where to look from, a path for each camera.
        folders: where the files of each are put.
        delivery: what is wanted.
        films: one for each path; none if empty.
        together: a film that shows all cameras at once.
        advanced: called after every view.

    Returns:
        By path, where each view was taken, how far it can be trusted, and its files, as JSON; and
        images a second of films.
    """
    fps = delivery.kinds.fps
    rates = [
        images_per_second([view.timestamp_ns for view in path.views]) if fps is None else fps
        for path in paths
    ]
    rows: list[list[dict[str, Any]]] = [[] for _ in paths]
    with ExitStack() as stack:
        writers = [
            stack.enter_context(video_file(film, rate))
            for film, rate in zip(films, rates, strict=False)
        ]
        rig = stack.enter_context(video_file(together, max(rates))) if together else None
        written = _written(paths, folders, delivery)
        for _, of_moment in groupby(written, key=attrgetter("frame_index")):
            seen: dict[int, list[Tensor]] = {}
            for view in of_moment:
                rows[view.place].append(view.row)
                seen[view.place] = view.images
                if writers:
                    writers[view.place].add(torch.cat(view.images, dim=1))
                advanced()
            if rig is not None:
                rig.add(_rig_image(paths, seen))
    return rows, max(rates)


class _Written(NamedTuple):
    """One view whose files are written."""

    frame_index: int
    place: int
    """Of its path among all."""
    row: dict[str, Any]
    """Where it was taken."""
    images: list[Tensor]
    """What films show of it."""


def _written(
    paths: Sequence[FollowedPath], folders: Sequence[Path], delivery: Delivery
) -> Iterator[_Written]:
    """Write all views, moment by moment; several at once where none leans on the one before."""
    moments = sorted(
        (view.frame_index, place, number)
        for place, path in enumerate(paths)
        for number, view in enumerate(path.views)
    )

    def write(moment: tuple[int, int, int]) -> _Written:
        frame_index, place, number = moment
        found = _write_view(paths[place], number, folders[place], delivery)
        return _Written(frame_index, place, *found)

    if any(path.painter is not None and path.painter.goes_in_order for path in paths):
        return map(write, moments)
    return side_by_side(write, moments, paths[0].builder.scene.device)


def _rig_image(paths: Sequence[FollowedPath], seen: dict[int, list[Tensor]]) -> Tensor:
    """What all cameras see at a moment, the companion above; black where one took no image."""
    rows = rig_rows(torch.stack([_ego_from_camera(path) for path in paths]))
    cameras = [path.camera(0) for path in paths]
    black = [torch.zeros(camera.height_px, camera.width_px, 3) for camera in cameras]
    layers = [
        [seen[place][layer] if place in seen else black[place] for place in range(len(paths))]
        for layer in range(len(next(iter(seen.values()))))
    ]
    return torch.cat([tiled(images, rows) for images in layers])


def _ego_from_camera(path: FollowedPath) -> Float[Tensor, "4 4"]:
    view, recorded = path.views[0], path.recorded
    world_from_ego = recorded.world_from_ego[recorded.frame_position(view.frame_index)]
    return invert_rigid(world_from_ego) @ view.camera.world_from_camera


def _write_view(
    path: FollowedPath, number: int, folder: Path, delivery: Delivery
) -> tuple[dict[str, Any], list[Tensor]]:
    """One view's files: where it was taken, and what films show of it."""
    view, camera = path.views[number], path.camera(number)
    kinds, beside = delivery.kinds, delivery.beside
    shown = path.shown(camera, view)
    seen = [shown.rgb]
    if beside is not None:
        other = _beside(beside, path, camera, view, shown)
        seen.insert(0, other.to(shown.rgb.device))
    wanted: list[tuple[str, Callable[..., Path], Tensor | None]] = []
    if kinds.images:
        wanted += [
            ("file", write_png, shown.rgb),
            (UNPAINTED_FOLDER, write_png, shown.unpainted_rgb),
            ("beside", write_png, None if beside is None else torch.cat(seen, dim=1)),
        ]
    if kinds.depth:
        wanted.append(("depth", write_depth_png, shown.depth_m))
    if kinds.semantics:
        who = instance_image(path.builder.scene, camera, view.timestamp_ns)
        wanted.append(("semantics", write_index_png, who))
    name = f"{view.frame_index:04d}.png"
    row = image_record(name, camera, view)
    if kinds.has_poses:
        row |= {**_confidence(path, camera, view, delivery.calibration), "file": None}
    for kind, write, pixels in wanted:
        if pixels is not None:
            row[kind] = name if kind == "file" else f"{kind}/{name}"
            write(pixels, folder / row[kind])
    return row, seen


def _beside(
    beside: str | GaussianScene,
    path: FollowedPath,
    camera: Camera,
    view: RecordedView,
    shown: ShownMoment,
) -> Float[Tensor, "height width 3"]:
    """What stands to the left of an image, in [0, 1] and of the same size."""
    if beside == RECORDING:
        return recorded_image(path, camera, view)
    if isinstance(beside, GaussianScene):
        other = beside.render(camera, view.timestamp_ns, camera_name=view.camera_name)
        return other.rgb.clamp(0, 1)
    return shown.rgb if shown.unpainted_rgb is None else shown.unpainted_rgb


def _confidence(
    path: FollowedPath, camera: Camera, view: RecordedView, calibration: Calibration
) -> dict[str, Any]:
    """How far the scene can be trusted there, before anybody paints it; None in a style."""
    if path.evidence is None:
        return {"confidence": None, "predicted_db": None}
    found = path.evidence.of(camera, view.timestamp_ns, view.camera_name)
    return asdict(calibration.of(found))


def legend(scene: GaussianScene) -> dict[str, Any]:
    """What the numbers of a semantics image stand for."""
    classes = sorted({track.category for track in scene.actors.recorded_tracks})
    numbers = {name: number for number, name in enumerate(classes, start=1)}
    actors = {
        str(body): {
            "actor_id": track.actor_id,
            "class": track.category,
            "class_id": numbers[track.category],
        }
        for body, track in enumerate(scene.actors.recorded_tracks, start=1)
    }
    return {
        "format": "16-bit PNG; every pixel is the number of what gives most of it",
        "instances": {str(STREET): {"class": "street", "class_id": 0}, **actors}
        | {str(SKY): {"class": "sky", "class_id": SKY}},
        "note": "parked cars are part of the street",
    }


def rig_rows(ego_from_camera: Float[Tensor, "cameras 4 4"]) -> tuple[tuple[int, ...], ...]:
    """Positions of the cameras, row by row, so that what is on the left in the car is on the left.

    Cameras that look the same way stand in the order of their lenses.
    """
    upper: list[tuple[int, float, int]] = []
    lower: list[tuple[int, float, int]] = []
    for camera, pose in enumerate(ego_from_camera.tolist()):
        azimuth_deg = math.degrees(math.atan2(pose[1][2], pose[0][2]))  # of z, which looks ahead
        from_behind_deg = math.copysign(180 - abs(azimuth_deg), azimuth_deg)
        is_ahead = abs(azimuth_deg) <= MOST_AHEAD_DEG
        left_deg = azimuth_deg if is_ahead else from_behind_deg
        (upper if is_ahead else lower).append((-round(left_deg), -pose[1][3], camera))
    return tuple(tuple(camera for *_, camera in sorted(row)) for row in (upper, lower) if row)


def tiled(
    images: Sequence[Float[Tensor, "_ _ 3"]], rows: Sequence[Sequence[int]]
) -> Float[Tensor, "height width 3"]:
    """One image of several: all as high as the least high, the narrower row in the middle."""
    height_px = min(image.shape[0] for image in images)
    strips = [torch.cat([_as_high(images[one], height_px) for one in row], dim=1) for row in rows]
    width_px = max(strip.shape[1] for strip in strips)
    for number, strip in enumerate(strips):
        lacking = width_px - strip.shape[1]
        strips[number] = pad(strip, (0, 0, lacking // 2, lacking - lacking // 2))
    return torch.cat(strips)


def _as_high(image: Float[Tensor, "_ _ 3"], height_px: int) -> Float[Tensor, "{height_px} _ 3"]:
    image = image.detach().cpu()
    height, width, _ = image.shape
    if height == height_px:
        return image
    size = (max(round(width * height_px / height), 1), height_px)
    return torch.from_numpy(cv2.resize(image.numpy(), size, interpolation=cv2.INTER_AREA))
