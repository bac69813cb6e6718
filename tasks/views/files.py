"""What is written of a followed path: images, depth, who is where, films, pairs side by side."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.conditioning.followed_paths import (
    FollowedPath,
    ShownMoment,
    image_record,
)
from lidarpainter_models.export.images import write_depth_png, write_index_png, write_png
from lidarpainter_models.export.videos import VideoWriter, images_per_second, video_file
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.instance_images import SKY, STREET, instance_image
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.observations.fit_size import shrink_image
from lidarpainter_models.scenes.records import RecordedView
from tasks.json_files import write_json

POSES_FILE = "trajectory.json"
LEGEND_FILE = "semantics.json"
VIDEO_FILE = "video.mp4"
UNPAINTED_FOLDER = "unpainted"

Beside = Literal["recorded", "unpainted"]


@dataclass(frozen=True, kw_only=True)
class ViewKinds:
    """Which files are wanted of every view."""

    images: bool = True
    depth: bool = False
    """Camera z as 16-bit PNG, in 256ths of a metre."""
    semantics: bool = False
    """Who is where as 16-bit PNG, with a legend."""
    video: bool = False
    fps: float | None = None
    """Images a second of the film; None takes those of the recording."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Companion:
    """What is shown to the left of every image."""

    beside: Beside | GaussianScene
    """The recording, the render before it was painted, or another scene of the same log."""

    def image(
        self, path: FollowedPath, camera: Camera, view: RecordedView, shown: ShownMoment
    ) -> Float[Tensor, "height width 3"]:
        """The other image, in [0, 1] and of the same size."""
        if self.beside == "recorded":
            return recorded_image(path, camera, view)
        if isinstance(self.beside, GaussianScene):
            other = self.beside.render(camera, view.timestamp_ns, camera_name=view.camera_name)
            return other.rgb.clamp(0, 1)
        return shown.rgb if shown.unpainted_rgb is None else shown.unpainted_rgb


def recorded_image(
    path: FollowedPath, camera: Camera, view: RecordedView
) -> Float[Tensor, "height width 3"]:
    """What was recorded at a moment, at the size of a camera."""
    image = path.recorded.read_image(view)
    size = {"width_px": camera.width_px, "height_px": camera.height_px}
    return shrink_image(image, **size).float() / 255


def write_views(
    path: FollowedPath,
    kinds: ViewKinds,
    folder: Path,
    *,
    companion: Companion | None = None,
    video: Path | None = None,
    advanced: Callable[[], None],
) -> dict[str, Any]:
    """Write everything that is wanted of a path.

    Args:
        path: where to look from.
        kinds: what is wanted.
        folder: where files and the poses they were taken from are put.
        companion: what stands to the left, in films and in `beside/`.
        video: another place for the film than `video.mp4` in the folder.
        advanced: called after every view.
    """
    recorded_fps = images_per_second([view.timestamp_ns for view in path.views])
    fps = recorded_fps if kinds.fps is None else kinds.fps
    film = video_file(video or folder / VIDEO_FILE, fps) if kinds.video else nullcontext()
    rows = []
    with film as frames:
        for number in range(len(path.views)):
            rows.append(_write_view(path, number, kinds, folder, companion, frames))
            advanced()
    collisions = [found.to_dict() for found in path.collisions()]
    wants_folder = kinds.images or kinds.depth or kinds.semantics
    if kinds.semantics:
        write_json(folder / LEGEND_FILE, legend(path.builder.scene))
    if wants_folder:
        about = {"trajectory": path.trajectory.spec, "collisions": collisions}
        write_json(folder / POSES_FILE, {**about, "images": rows})
    made: dict[str, Any] = {
        "camera": path.camera_name,
        "num_images": len(rows),
        "collisions": collisions,
    }
    return made | ({"video": str(video or folder / VIDEO_FILE), "fps": fps} if kinds.video else {})


def _write_view(
    path: FollowedPath,
    number: int,
    kinds: ViewKinds,
    folder: Path,
    companion: Companion | None,
    frames: VideoWriter | None,
) -> dict[str, Any]:
    """One view's files, and where it was taken."""
    view, camera = path.views[number], path.camera(number)
    shown = path.shown(camera, view)
    pair = shown.rgb
    if companion is not None:
        other = companion.image(path, camera, view, shown)
        pair = torch.cat([other.to(shown.rgb.device), shown.rgb], dim=1)
    if frames is not None:
        frames.add(pair)
    wanted: list[tuple[str, Callable[..., Path], Tensor | None]] = []
    if kinds.images:
        wanted += [
            ("file", write_png, shown.rgb),
            (UNPAINTED_FOLDER, write_png, shown.unpainted_rgb),
            ("beside", write_png, pair if companion else None),
        ]
    if kinds.depth:
        wanted.append(("depth", write_depth_png, shown.depth_m))
    if kinds.semantics:
        who = instance_image(path.builder.scene, camera, view.timestamp_ns)
        wanted.append(("semantics", write_index_png, who))
    name = f"{view.frame_index:04d}.png"
    row = {**image_record(name, camera, view), "file": None}
    for kind, write, pixels in wanted:
        if pixels is not None:
            row[kind] = name if kind == "file" else f"{kind}/{name}"
            write(pixels, folder / row[kind])
    return row


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
