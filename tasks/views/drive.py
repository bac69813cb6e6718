"""A finished run in a browser: as a page that plays it from the disk, or live."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lidarpainter_models
from catalog.artefacts import ArtefactRef
from catalog.store import open_store
from lidarpainter_models.conditioning.followed_paths import FollowedPath
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.export.view_requests import ViewRequest, only_path
from lidarpainter_models.geometry.trajectory_specs import Trajectory, parse_trajectory
from lidarpainter_models.geometry.trajectory_words import RECORDED
from lidarpainter_models.storage.whole_files import write_whole
from tasks.evaluation.shown import view_time_painting
from tasks.lidar.channel import lidar_of, load_channel, mounted
from tasks.opened import OpenedRun, opened
from tasks.progress import listener, progress_of
from tasks.specs import FittedRef
from tasks.stored import load_scene
from tasks.views.render import ViewedRun, followed_paths

if TYPE_CHECKING:
    from torch import Tensor

    from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
    from lidarpainter_models.viewing.drive_nodes import ShownDrive

STAGE = "page"
SHOWN = "painted"
"""What the scene of a run at its end is called."""
BESIDE = ("lateral:2", "lateral:-2", RECORDED)
"""Where the page drives after the recorded path, if nothing else is asked for: the first of these
that leads into no wall."""


def write_page(viewed: ViewedRun, request: ViewRequest, out: Path) -> dict[str, Any]:
    """Write a page that drives the recorded path, then the one asked for or one beside it.

    Raises:
        SceneError: the run did not train on that camera, or no frame is left.
        ConfigError: the path leads into a wall.
        WriteError: the file cannot be written.
    """
    from lidarpainter_models.export.page import PageNotes
    from lidarpainter_models.viewing.drive_nodes import Leg, recorded_page

    drive = shown_drive(viewed, request, {SHOWN: viewed.fitted})
    trajectory = request.trajectory
    aside = _beside(drive.path) if trajectory.is_recorded else trajectory
    recorded = drive.path.recorded
    name = f"{recorded.dataset}/{recorded.sequence}"
    notes = PageNotes(
        title=f"LidarPainter: {name}",
        licence=recorded.manifest["licence"],
        software=f"lidarpainter {lidarpainter_models.__version__}",
    )
    legs = [Leg(title=f"{name}, recorded", trajectory=parse_trajectory(RECORDED))]
    if not aside.is_recorded:
        legs.append(Leg(title=f"{name}, {aside.spec}", trajectory=aside))
    listener().started(STAGE)
    page = recorded_page(drive, legs, notes, progress=progress_of(STAGE))
    write_whole(out, page.encode("utf-8"))
    return {"path": str(out), "bytes": len(page), "num_moments": len(drive.path.views)}


def view_live(
    viewed: ViewedRun,
    request: ViewRequest,
    scenes: Mapping[str, FittedRef],
    *,
    lidar: ArtefactRef | None = None,
    port: int | None,
    opened_at: Callable[[str], None],
    stopped: threading.Event,
) -> None:
    """Show a drive in a browser until stopped; tells its address when it is there.

    Args:
        viewed: the run whose path is followed, and whose scene painters are shown.
        request: the camera and the frames that are followed.
        scenes: fitted scenes by the names that people choose from; the first is shown first.
        lidar: what the log's first LiDAR was learnt to see; None shows no simulated sweeps.
        port: where to listen; None takes a free one.
        opened_at: told the address.
        stopped: ends the viewer when it is set.

    Raises:
        SceneError: the run did not train on that camera, or no frame is left.
        ConfigError: the port is in use or not allowed.
    """
    from lidarpainter_models.viewing.viewer import live_viewer

    this = opened(viewed.run)
    painting = view_time_painting(
        this.store, viewed.fitted, viewed.conditions, this.painter, this.device
    )
    label = f"{this.scene.dataset}/{this.scene.sequence}"
    drive = shown_drive(viewed, request, scenes)
    if lidar is not None:
        drive = replace(drive, sweeps=_sweeps(this, viewed.fitted, lidar))
    with live_viewer(drive, painting, label=label, port=port) as (viewer, address):
        opened_at(address)
        viewer.play(stopped)


def _sweeps(
    this: OpenedRun, fitted: FittedRef, ref: ArtefactRef
) -> Callable[["GaussianScene", int, "Tensor"], "Tensor"]:
    """Simulated sweeps of the first LiDAR, as the viewer asks for them."""
    channel = load_channel(this.store, ref)
    name = lidar_of(this.scene, None)
    lidar = mounted(this, load_scene(this.store, fitted.gaussians), name)
    swept = (sweep for sweep in this.scene.sweeps if sweep.lidar_name == name)
    times_ns = {sweep.frame_index: sweep.timestamp_ns for sweep in swept}

    def points(scene: "GaussianScene", frame_index: int, aside_m: "Tensor") -> "Tensor":
        rays = lidar.rays(times_ns[frame_index])
        rays = replace(rays, origin_m=rays.origin_m + aside_m)
        return channel.simulated(scene, rays, seed=frame_index).returns(1).xyz_m(rays).float()

    return points


def _beside(path: FollowedPath) -> Trajectory:
    ways = (parse_trajectory(spec) for spec in BESIDE)
    return next(way for way in ways if not _meets_walls(replace(path, trajectory=way)))


def _meets_walls(path: FollowedPath) -> bool:
    try:
        path.refuse_walls()
    except ConfigError:
        return True
    return False


def shown_drive(
    viewed: ViewedRun, request: ViewRequest, scenes: Mapping[str, FittedRef]
) -> "ShownDrive":
    """Load what is shown; scenes other than the run's own when they are asked for."""
    from lidarpainter_models.viewing.drive_nodes import ShownDrive

    path = only_path(followed_paths(viewed, request), request)
    store = open_store(viewed.run.store_path)
    return ShownDrive(
        path=replace(path, trajectory=parse_trajectory(RECORDED)),
        scenes={
            name: partial(load_scene, store, fitted.gaussians) for name, fitted in scenes.items()
        },
    )
