"""What is written of a followed path: images, depth, who is where, films, pairs side by side."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lidarpainter_models.conditioning.followed_paths import (
    FollowedPath,
    ShownMoment,
    image_record,
)
from lidarpainter_models.evaluation.view_confidence import Calibration
from lidarpainter_models.export.images import write_depth_png, write_index_png, write_png
from lidarpainter_models.export.rig_images import rig_rows, tiled
from lidarpainter_models.export.videos import images_per_second, video_file
from lidarpainter_models.export.view_requests import RECORDING, ViewKinds
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.instance_images import SKY, STREET, instance_image
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.observations.fit_size import shrink_image
from lidarpainter_models.scenes.records import RecordedView

UNPAINTED_FOLDER = "unpainted"


@dataclass(frozen=True, kw_only=True, eq=False)
class Companion:
    """What is shown to the left of every image."""

    beside: str | GaussianScene
    """The recording, the render before it was painted, or another scene of the same log."""

    def image(
        self, path: FollowedPath, camera: Camera, view: RecordedView, shown: ShownMoment
    ) -> Float[Tensor, "height width 3"]:
        """The other image, in [0, 1] and of the same size."""
        if self.beside == RECORDING:
            return recorded_image(path, camera, view)
        if isinstance(self.beside, GaussianScene):
            other = self.beside.render(camera, view.timestamp_ns, camera_name=view.camera_name)
            return other.rgb.clamp(0, 1)
        return shown.rgb if shown.unpainted_rgb is None else shown.unpainted_rgb


@dataclass(frozen=True, kw_only=True, eq=False)
class Delivery:
    """What is written of every view."""

    kinds: ViewKinds
    calibration: Calibration
    """Turns evidence into confidence."""
    companion: Companion | None = None
    """What stands to the left in films and in `beside/`, above in a film of all cameras."""


@dataclass(frozen=True, kw_only=True)
class WrittenViews:
    """What was written of the paths of a rig."""

    rows: list[list[dict[str, Any]]]
    """By path: where each view was taken, how far it can be trusted, and its files, as JSON."""
    fps: float
    """Images a second of films."""


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
) -> WrittenViews:
    """Write everything that is wanted of the paths of a rig, moment by moment.

    Args:
        paths: where to look from, a path for each camera.
        folders: where the files of each are put.
        delivery: what is wanted.
        films: one for each path; none if empty.
        together: a film that shows all cameras at once.
        advanced: called after every view.
    """
    rates = [_images_per_second(path, delivery.kinds) for path in paths]
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
    return WrittenViews(rows=rows, fps=max(rates))


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
    paths: Sequence[FollowedPath],
    folders: Sequence[Path],
    delivery: Delivery,
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


def _images_per_second(path: FollowedPath, kinds: ViewKinds) -> float:
    if kinds.fps is not None:
        return kinds.fps
    return images_per_second([view.timestamp_ns for view in path.views])


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
    kinds, companion = delivery.kinds, delivery.companion
    shown = path.shown(camera, view)
    seen = [shown.rgb]
    if companion is not None:
        seen.insert(0, companion.image(path, camera, view, shown).to(shown.rgb.device))
    wanted: list[tuple[str, Callable[..., Path], Tensor | None]] = []
    if kinds.images:
        wanted += [
            ("file", write_png, shown.rgb),
            (UNPAINTED_FOLDER, write_png, shown.unpainted_rgb),
            ("beside", write_png, torch.cat(seen, dim=1) if companion else None),
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
