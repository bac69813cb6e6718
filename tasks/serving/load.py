"""Load a finished run as a scene that answers simulators."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from catalog.artefacts import ArtefactRef
from lidarpainter_models.devices import Device
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.serving.painted_streams import PaintedStreams
from lidarpainter_models.serving.renderer import ServedScene
from lidarpainter_models.serving.scene_pool import LoadedScene
from tasks.evaluation.shown import condition_builder
from tasks.lidar.channel import load_channel
from tasks.opened import opened
from tasks.stored import load_scene
from tasks.views.render import ViewedRun

GROWTH = 3
"""Bytes in memory per byte on the disk: arrays as they are, blocks of Gaussians, kept sources."""


def load_served(
    viewed: ViewedRun,
    envelope: Mapping[str, Any] | None,
    *,
    device: Device,
    is_painted: bool,
    is_measured: bool,
    lidar: ArtefactRef | None,
    name: str,
) -> LoadedScene:
    """Load what a run's images are made from, and its sweeps where a LiDAR channel is given.

    Raises:
        ConfigError: a scene in a style is to be painted, or the device is not there.
    """
    run = replace(viewed.run, device=device)
    this, fitted = opened(run), viewed.fitted
    style = load_scene(this.store, fitted.gaussians).style
    if is_painted and style is not None:
        raise ConfigError(
            f"run {name} is in the style {style.mix.text}, and painters know clear days: serve it "
            "without --paint"
        )
    builder = condition_builder(this.store, fitted, viewed.conditions, this.device)
    streams = None
    if is_painted:
        streams = PaintedStreams(painter_of_scene=this.painter.load(this.device))
    served = ServedScene(
        scene_id=name,
        recorded=this.scene,
        builder=builder,
        observation=viewed.observation,
        calibration=viewed.calibration,
        envelope=envelope,
        is_measured=is_measured,
        streams=streams,
        returns=None if lidar is None else load_channel(this.store, lidar),
    )
    parts = (fitted.gaussians, fitted.observations, *(() if lidar is None else (lidar,)))
    files = [this.store.artefacts.files(ref) for ref in parts]
    num_bytes = sum(path.stat().st_size for folder in files for path in folder.iterdir())
    return LoadedScene(served, GROWTH * num_bytes)
