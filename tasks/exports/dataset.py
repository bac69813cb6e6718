"""Write a drive as a data set: its recorded log, or images and views beside to reconstruct from."""

from pathlib import Path
from typing import Any

from lidarpainter_models.conditioning.followed_paths import FollowedPath
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.export.datasets import IMAGE_FOLDER, PosedImage, map_sample
from lidarpainter_models.export.formats import ExportFormat
from lidarpainter_models.export.images import write_png
from lidarpainter_models.export.view_files import recorded_image
from lidarpainter_models.export.view_requests import ViewRequest
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from lidarpainter_models.geometry.trajectory_words import RECORDED
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.storage.whole_files import write_whole
from tasks.exports.places import STAGE, new_folder
from tasks.opened import opened
from tasks.progress import listener, progress_of
from tasks.stored import load_observations
from tasks.views.render import ViewedRun, followed_paths


def export_log(
    scene: DrivingScene, row: ExportFormat, frames: slice | None, out: Path
) -> dict[str, Any]:
    """Write frames of a recorded scene into a new folder; all of them if None.

    Raises:
        SceneError: no frame is left, or the format has no place for something in the scene.
        MissingPackageError: the format's extra is not installed.
        ConfigError: something is there already.
        WriteError: the disk refuses; nothing is left half-written.
    """
    wanted = frozenset(scene.frame_indices[frames or slice(None)])
    listener().started(STAGE)
    with new_folder(out) as folder:
        made = row.load_writer()(folder, scene, wanted, progress_of(STAGE))
    num_bytes = sum(file.stat().st_size for file in out.iterdir())
    return {"path": str(out), "num_bytes": num_bytes, **made}


def export_dataset(
    viewed: ViewedRun, request: ViewRequest, row: ExportFormat, out: Path
) -> dict[str, Any]:
    """Write recorded images, views beside them, their refined poses, and points of the LiDAR map.

    Recorded images have their own width, views beside that of the fit, unless one is asked for.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
        ConfigError: something is there already, or the recorded path is to be rendered.
        WriteError: the disk refuses; nothing is left half-written.
    """
    has_beside = not request.trajectory.is_recorded or request.is_painted
    if has_beside and request.trajectory.is_recorded:
        raise ConfigError("recorded images are taken as they are: --trajectory lateral:2, ...")
    this = opened(viewed.run)
    widest_px = max(view.camera.width_px for view in this.scene.views)
    plain = ViewRequest(
        trajectory=parse_trajectory(RECORDED),
        camera=request.camera,
        frames=request.frames,
        width_px=request.width_px or widest_px,
        allows_collisions=request.allows_collisions,
    )
    recorded = followed_paths(viewed, plain)
    beside = followed_paths(viewed, request) if has_beside else []
    listener().started(STAGE)
    total = sum(len(path.views) for path in (*recorded, *beside))
    images: list[PosedImage] = []
    street = load_observations(this.store, viewed.fitted.observations).lidar_map.street
    points = map_sample(street.measured())
    with new_folder(out) as folder:
        for write, paths in ((_write_recorded, recorded), (_write_seen, beside)):
            for path in paths:
                for number in range(len(path.views)):
                    images.append(write(path, number, folder / IMAGE_FOLDER))
                    listener().advanced(STAGE, len(images), total, "")
        row.load_writer()(folder, images, points)
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
    write_png(path.shown(camera, view).rgb, folder / name)
    return PosedImage(name=name, camera=camera, timestamp_ns=view.timestamp_ns)
