"""Edit a finished run: who is where, mended where somebody was, masked for painters."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch

from catalog.artefacts import Workplace
from catalog.digests import digest_file
from catalog.store import Store, open_store
from lidarpainter_models.conditioning.scene_styles import styled_scene
from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.editing.actor_models import ActorModel
from lidarpainter_models.editing.apply import edited, encounters
from lidarpainter_models.editing.filled_scenes import filled, masked_observations
from lidarpainter_models.editing.scene_merging import OtherRun
from lidarpainter_models.editing.script import (
    ActorSource,
    Insert,
    Join,
    Lamps,
    Move,
    Operation,
    Style,
    Swap,
)
from lidarpainter_models.editing.worlds import EditedWorld
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene, describe
from lidarpainter_models.gaussians.model.styling.scene_style import LampChange
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.observations.views import SceneObservations
from lidarpainter_models.painter.known_painters import NO_PAINTER
from lidarpainter_models.painter.selection import PainterChoice
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.storage.tensor_files import write_tensors
from lidarpainter_models.weather.mix import StyleMix
from tasks.editing.donors import PARKED, digests_of, donor_of, model_of, opened_world
from tasks.opened import global_frame_of, open_scene
from tasks.progress import Progress
from tasks.runs import FinishedRun, open_run
from tasks.stored import load_observations, load_scene, save_observations, save_scene


def put_style(
    place: Workplace,
    progress: Progress,
    *,
    scene: Callable[[], GaussianScene],
    observations: Callable[[], SceneObservations],
    recorded: Callable[[], DrivingScene],
    mix: StyleMix,
    seed: int,
) -> dict[str, Any]:
    """The build of a styled scene; see `flows.derive`."""
    styled = styled_scene(
        scene(),
        observations(),
        recorded(),
        mix,
        seed=seed,
        progress=lambda done, total: progress(done, total, "looking for lamps"),
    )
    save_scene(place.output, styled, [])
    return describe(styled)


FILLED_FILE = "filled.safetensors"
"""Confidence of the last Gaussians of the scene, which were filled in."""


@dataclass(frozen=True, kw_only=True)
class Edits:
    """What is done to a run; everything is read when it is first asked for."""

    store: Store
    source: FinishedRun
    operations: tuple[Operation, ...]

    @property
    def inputs(self) -> dict[str, str]:
        """Digests of what is read beside the run's artefacts, by the part it plays."""
        found = {"scene": open_scene(self.store, self.source.scene_id).content_digest}
        for number, operation in enumerate(self.operations, start=1):
            if isinstance(operation, Insert | Swap):
                donor = donor_of(self._store_of(operation.source), operation.source)
                found |= digests_of(f"actor-{number}", donor)
            if isinstance(operation, Join):
                found |= self._digests_of_joined(f"run-{number}", operation)
            if isinstance(operation, Insert | Move):
                way = parse_trajectory(operation.trajectory, max_shift_m=None)
                found |= {f"waypoints-{number}": digest_file(path) for path in way.files}
        return found

    @property
    def style(self) -> Style | None:
        """The last one that is asked for."""
        return next((one for one in reversed(self.operations) if isinstance(one, Style)), None)

    @cached_property
    def world(self) -> EditedWorld:
        """The run as it is after them; checked, masked and filled it is the same.

        Raises:
            ConfigError: an operation cannot be done.
        """
        if any(isinstance(one, Lamps) for one in self.operations):
            self._require_night()
        before = opened_world(self.store, self.source)
        return edited(before, self.operations, self._models(), self._others())

    def _require_night(self) -> None:
        worn = load_scene(self.store, self.source.final.gaussians).style
        mixes = [one.mix for one in self.operations if isinstance(one, Style)]
        mixes += [] if worn is None else [worn.mix]
        if "night" not in {share.prompt for mix in mixes for share in mix.shares}:
            raise ConfigError(
                "lamps are seen at night alone: expected a style with night, among the operations "
                "or in the run"
            )

    def _models(self) -> Mapping[ActorSource, ActorModel]:
        """What actors of other runs and of files look like."""
        sources = [one.source for one in self.operations if isinstance(one, Insert | Swap)]
        return {
            one: model_of(self._store_of(one), one)
            for one in sources
            if one.run or one.ply or one.asset
        }

    def _others(self) -> dict[Join, OtherRun]:
        """The runs that are joined."""
        return {one: self._other(one) for one in self.operations if isinstance(one, Join)}

    def _other(self, operation: Join) -> OtherRun:
        store = self._store_of(operation)
        run = open_run(store, operation.run)
        ours = open_scene(self.store, self.source.scene_id)
        theirs = open_scene(store, run.scene_id)
        if global_frame_of(ours) != global_frame_of(theirs):
            raise ConfigError(
                f"join {operation.run}: nothing ties the frame of {run.scene_id} to that of "
                f"{self.source.scene_id}, expected the same sequence or the same global_frame"
            )
        return OtherRun(
            world=opened_world(store, run),
            world_from_other=invert_rigid(ours.global_from_world) @ theirs.global_from_world,
            is_same_drive=run.scene_id == self.source.scene_id,
        )

    def _digests_of_joined(self, part: str, operation: Join) -> dict[str, str]:
        store = self._store_of(operation)
        run = open_run(store, operation.run)
        scene = open_scene(store, run.scene_id)
        return {**digests_of(part, run), f"{part}-scene": scene.content_digest}

    def _store_of(self, source: ActorSource | Join) -> Store:
        return self.store if source.store is None else open_store(source.store)


def build_edited(
    place: Workplace,
    _progress: Progress,
    *,
    edits: Edits,
    conditions: ConditionConfig,
    painter: PainterChoice,
    device: torch.device,
) -> dict[str, Any]:
    """Write the edited scene."""
    world = edits.world
    paints = painter.name != NO_PAINTER
    found = filled(world, conditions, painter.load(device) if paints else None)
    scene = _styled(found.scene, edits, world.lamps)
    save_scene(place.output, scene, [])
    write_tensors(place.output / FILLED_FILE, {"confidence": found.confidence}, {})
    mean = float(found.confidence.mean()) if len(found.confidence) else None
    return describe(scene) | {
        "num_filled": len(found.confidence),
        "num_filled_ground": found.num_ground,
        "mean_filled_confidence": mean,
        "encounters": [str(one) for one in encounters(world)],
    }


def _styled(scene: GaussianScene, edits: Edits, lamps: tuple[LampChange, ...]) -> GaussianScene:
    """The edited scene in the style that it is put in, or else in that of its source."""
    store, final = edits.store, edits.source.final
    before, style = load_scene(store, final.gaussians).style, edits.style
    if style is None:
        scene = replace(scene, style=before)
    else:
        seen, recorded = load_observations(store, final.observations), edits.source.scene_id
        scene = styled_scene(scene, seen, open_scene(store, recorded), style.mix, seed=style.seed)
    if scene.style is None:
        return scene
    known = () if before is None else before.lamps
    return replace(scene, style=replace(scene.style, lamps=(*known, *lamps)))


def build_observations(place: Workplace, _progress: Progress, *, edits: Edits) -> dict[str, Any]:
    """Write what may be seen of the edited scene."""
    world = edits.world
    seen = masked_observations(world)
    save_observations(place.output, seen)
    hidden = [float(view.hidden.float().mean()) for view in seen.views if view.hidden is not None]
    return {
        "num_views": len(seen.views),
        "hidden_share": sum(hidden) / max(len(hidden), 1),
        PARKED: [track.actor_id for track in world.parked],
    }
