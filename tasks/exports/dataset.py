"""Write a drive as a data set that others reconstruct from: recorded images, and views beside."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from lidarpainter_models.conditioning.followed_paths import FollowedPath
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.export.datasets import (
    IMAGE_FOLDER,
    PosedImage,
    map_sample,
    write_colmap,
    write_nerfstudio,
)
from lidarpainter_models.export.images import write_png
from lidarpainter_models.storage.whole_files import write_whole
from tasks.exports.places import new_folder
from tasks.opened import opened
from tasks.progress import listener
from tasks.specs import FittedRef, RunSpec
from tasks.stages import stage_task
from tasks.stored import load_observations
from tasks.views.files import recorded_image
from tasks.views.render import RenderRequest, followed_paths

STAGE = "export"
DatasetFormat = Literal["colmap", "nerfstudio"]


@dataclass(frozen=True, kw_only=True)
class DatasetRequest:
    """Which images are wanted, in which form."""

    format: DatasetFormat
    recorded: RenderRequest
    """Whose recorded images are taken, and how wide."""
    beside: RenderRequest | None
    """The rendered or painted views to add; None adds none."""

    def __post_init__(self) -> None:
        """Refuse renders of what was recorded."""
        if self.beside is not None and self.beside.trajectory.is_recorded:
            raise ConfigError("recorded images are taken as they are: --trajectory lateral:2, ...")


@stage_task
def export_dataset(
    run: RunSpec, fitted: FittedRef, request: DatasetRequest, out: Path
) -> dict[str, Any]:
    """Write images, the poses that the fit found, and the points of the LiDAR map.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
        ConfigError: something is there already.
        WriteError: the disk refuses; nothing is left half-written.
    """
    recorded = followed_paths(run, fitted, request.recorded)
    beside = [] if request.beside is None else followed_paths(run, fitted, request.beside)
    listener().started(STAGE)
    total = sum(len(path.views) for path in (*recorded, *beside))
    images: list[PosedImage] = []
    points = map_sample(load_observations(opened(run).store, fitted.observations).lidar_map.street)
    with new_folder(out) as folder:
        for write, paths in ((_write_recorded, recorded), (_write_seen, beside)):
            for path in paths:
                for number in range(len(path.views)):
                    images.append(write(path, number, folder / IMAGE_FOLDER))
                    listener().advanced(STAGE, len(images), total, "")
        write_form = write_colmap if request.format == "colmap" else write_nerfstudio
        write_form(folder, images, points)
    return {
        "path": str(out),
        "num_images": len(images),
        "num_recorded": sum(len(path.views) for path in recorded),
        "num_points": len(points),
        "frame": "world x forward, y left, z up; metres",
    }


def _write_recorded(path: FollowedPath, number: int, folder: Path) -> PosedImage:
    """A recorded image: the camera's own bytes, or pixels where lens or size differ."""
    view, camera = path.views[number], path.camera(number)
    stem = f"{view.camera_name}/{view.frame_index:04d}"
    is_whole = camera.width_px == view.camera.width_px
    if is_whole and path.recorded.is_stored_undistorted(view):
        name = f"{stem}.jpg"
        write_whole(folder / name, path.recorded.read_jpeg(view))
    else:
        name = f"{stem}.png"
        write_png(recorded_image(path, camera, view), folder / name)
    return PosedImage(name=name, camera=camera, timestamp_ns=view.timestamp_ns)


def _write_seen(path: FollowedPath, number: int, folder: Path) -> PosedImage:
    """A view beside the recorded path, as rendered or painted."""
    view, camera = path.views[number], path.camera(number)
    name = f"{view.camera_name}_{path.trajectory.name}/{view.frame_index:04d}.png"
    write_png(path.image(camera, view), folder / name)
    return PosedImage(name=name, camera=camera, timestamp_ns=view.timestamp_ns)
