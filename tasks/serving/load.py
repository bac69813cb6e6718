"""Load a finished run as a scene that answers simulators."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from catalog.artefacts import ArtefactRef
from lidarpainter_models.devices import Device
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.serving.painted_streams import PaintedStreams
from lidarpainter_models.serving.renderer import ServedScene
from lidarpainter_models.serving.scene_edits import SceneEdits, with_parked_apart
from lidarpainter_models.serving.scene_pool import LoadedScene
from tasks.evaluation.shown import condition_builder
from tasks.lidar.channel import load_channel
from tasks.opened import opened
from tasks.serving.library import StoredActors
from tasks.stored import load_scene
from tasks.views.render import ViewedRun

GROWTH = 3
"""Bytes in memory per byte on the disk: arrays as they are, blocks of Gaussians, kept sources."""


@dataclass(frozen=True, kw_only=True)
class ServedAs:
    """How scenes answer."""

    device: Device = "auto"
    is_painted: bool = False
    painter: str | None = None
    """Name of the painter; None takes each run's own."""
    is_measured: bool = True
    """Whether the confidence of every image is measured."""
    is_parked_apart: bool = False
    """Whether clients may move and leave out parked cars."""
    has_placeholders: bool = False
    """Whether an asset stands for an actor that a scene does not have."""


def load_served(
    viewed: ViewedRun,
    envelope: Mapping[str, Any] | None,
    how: ServedAs,
    *,
    lidar: ArtefactRef | None,
    name: str,
) -> LoadedScene:
    """Load what a run's images are made from, and its sweeps where a LiDAR channel is given.

    Raises:
        ConfigError: a scene in a style is to be painted, or the device is not there.
    """
    run = replace(viewed.run, device=how.device)
    this, fitted = opened(run), viewed.fitted
    style = load_scene(this.store, fitted.gaussians).style
    if how.is_painted and style is not None:
        raise ConfigError(
            f"run {name} is in the style {style.mix.text}, and painters know clear days: serve it "
            "without --paint"
        )
    if how.is_parked_apart and style is not None:
        raise ConfigError(f"run {name} is in a style: serve it without --parked-apart")
    builder = condition_builder(this.store, fitted, viewed.conditions, this.device)
    streams = None
    if how.is_painted:
        streams = PaintedStreams(painter_of_scene=this.painter.load(this.device))
    served = ServedScene(
        scene_id=name,
        recorded=this.scene,
        builder=builder,
        observation=viewed.observation,
        calibration=viewed.calibration,
        envelope=envelope,
        is_measured=how.is_measured,
        streams=streams,
        returns=None if lidar is None else load_channel(this.store, lidar),
    )
    parts = (fitted.gaussians, fitted.observations, *(() if lidar is None else (lidar,)))
    files = [this.store.artefacts.files(ref) for ref in parts]
    num_bytes = sum(path.stat().st_size for folder in files for path in folder.iterdir())
    edits = SceneEdits(
        fitted=with_parked_apart(served) if how.is_parked_apart else served,
        library=StoredActors(this.store),
        has_placeholders=how.has_placeholders,
    )
    return LoadedScene(edits, GROWTH * num_bytes)
