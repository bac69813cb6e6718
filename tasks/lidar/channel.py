"""Learn what a LiDAR of a log sees in a fitted scene, beside the fit, which stays as it is."""

from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from catalog.artefacts import ArtefactRef, Workplace
from catalog.store import Store
from lidarpainter_models.errors import SceneError
from lidarpainter_models.gaussians.lidar_returns.channel import LidarChannel, channel_from_arrays
from lidarpainter_models.gaussians.lidar_returns.fitting import fit_lidar
from lidarpainter_models.gaussians.lidar_returns.settings import LidarConfig
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.lidar.firings import MountedLidar, mounted_lidar
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.storage.tensor_files import read_tensors, write_tensors
from tasks.opened import OpenedRun, opened
from tasks.progress import Progress
from tasks.specs import FittedRef, RunSpec
from tasks.stages import StageResult, run_stage, stage_task
from tasks.stored import load_scene

STAGE = KIND = "lidar"
CHANNEL_FILE = "lidar.safetensors"


@stage_task
def learn_lidar(
    run: RunSpec, fitted: FittedRef, config: LidarConfig, lidar_name: str | None = None
) -> StageResult:
    """Learn surfels, intensity, loss and noise of one LiDAR from the training sweeps of a run.

    Raises:
        SceneError: the scene has no such LiDAR, or none at all.
    """
    this = opened(run)
    name = lidar_of(this.scene, lidar_name)
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage=STAGE,
        kind=KIND,
        inputs={"scene": this.scene.content_digest, "gaussians": fitted.gaussians.digest},
        config={"split": run.split, "lidar": name, **asdict(config)},
        build=partial(_build, this=this, fitted=fitted, name=name, config=config),
    )


def lidar_of(scene: DrivingScene, name: str | None) -> str:
    """The LiDAR that is meant: the first of the log, unless another is named.

    Raises:
        SceneError: the scene has no such LiDAR, or none at all.
    """
    if name is None and scene.lidar_names:
        return scene.lidar_names[0]
    if name not in scene.lidar_names:
        names = ", ".join(scene.lidar_names) or "none"
        wanted = "a LiDAR" if name is None else f"LiDAR {name!r}"
        raise SceneError(f"{scene.path.name}: {wanted} is needed, the scene has {names}")
    return name


def corrected_scene(this: OpenedRun, fitted: GaussianScene) -> DrivingScene:
    """The log with its poses as the fit found them."""
    return this.scene.corrected(fitted.cameras.path)


def mounted(this: OpenedRun, fitted: GaussianScene, name: str) -> MountedLidar:
    """The LiDAR of a run; what its log does not say is estimated from training sweeps."""
    return mounted_lidar(corrected_scene(this, fitted), name, this.views.train_frames)


def load_channel(store: Store, ref: ArtefactRef) -> LidarChannel:
    """The channel of an artefact, read and checked once in a process."""
    return _channel(store, ref, store.artefacts.files(ref) / CHANNEL_FILE)


@lru_cache(maxsize=1)
def _channel(store: Store, ref: ArtefactRef, path: Path) -> LidarChannel:
    store.artefacts.verified(ref)
    return channel_from_arrays(*read_tensors(path, damaged=SceneError))


def _build(
    place: Workplace,
    progress: Progress,
    *,
    this: OpenedRun,
    fitted: FittedRef,
    name: str,
    config: LidarConfig,
) -> dict[str, Any]:
    scene = load_scene(this.store, fitted.gaussians)
    channel = fit_lidar(
        corrected_scene(this, scene),
        scene,
        mounted(this, scene, name),
        this.views.train_frames,
        config,
        progress=progress,
    )
    write_tensors(place.output / CHANNEL_FILE, *channel.to_arrays())
    return {"lidar": name, "num_surfels": len(channel.surfels)}
