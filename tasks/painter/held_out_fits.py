"""What judges painters: pairs, and held-out views of finished runs, that none was trained on."""

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from catalog.store import open_store
from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.evaluation.held_back import (
    HeldOutPairs,
    held_out_pairs,
    unseen_pairs,
    unseen_views,
)
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.painting import ScoringPairs
from lidarpainter_models.evaluation.scene_evaluation import known_street
from lidarpainter_models.evaluation.settings import EvaluationConfig
from lidarpainter_models.training_data.pairs import PairSet, open_sets
from tasks.opened import open_split
from tasks.specs import FittedRef, SplitSpec
from tasks.stored import load_observations, load_scene


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutFit:
    """The first fit of a run: what a painter is shown before anything was painted."""

    store_path: Path
    run_id: str
    split: SplitSpec
    fitted: FittedRef
    settings: EvaluationConfig

    def open(self, trained: AbstractSet[str]) -> tuple[dict[str, HeldOutPairs], int]:
        """Its pairs, by scene and trajectory, without frames that painters were trained on.

        Returns:
            The pairs, and how many held-out views of each trajectory were left out.
        """
        store = open_store(self.store_path)
        recorded, views = open_split(store, self.split)
        unseen = unseen_views(views.test, self.split.scene_id, trained)
        seen = load_observations(store, self.fitted.observations)
        scene = load_scene(store, self.fitted.gaussians)
        found = held_out_pairs(
            ConditionBuilder(scene, seen.lidar_map, seen.views, config=self.settings.conditions),
            HeldOut(scene=recorded, test_views=unseen, observation=self.settings.observation),
            known_street(recorded),
            self.settings.scoring.shifts,
        )
        named = {f"{self.split.scene_id} {name}": pairs for name, pairs in found.items()}
        return named, len(views.test) - len(unseen)


def unseen_sources(
    sets: Sequence[PairSet], fits: Sequence[HeldOutFit], learnt: Sequence[frozenset[str]]
) -> tuple[dict[str, ScoringPairs], dict[str, Any]]:
    """Pairs that no painter was trained on, and how many of every set those are.

    Raises:
        ConfigError: neither pairs nor runs, or two runs of one scene, whose figures would bear one
            name.
        DataError: a painter was trained on all of them.
    """
    scenes = [fit.split.scene_id for fit in fits]
    twice = sorted({scene for scene in scenes if scenes.count(scene) > 1})
    if twice:
        raise ConfigError(f"judge by one run of each scene, got two of {', '.join(twice)}")
    sources: dict[str, ScoringPairs] = {}
    counts: dict[str, Any] = {}
    if sets or not fits:
        folders = open_sets(sets)
        unseen = unseen_pairs(folders, learnt)
        sources |= unseen
        for name, folder in folders.items():
            judged = len(unseen.get(name, ()))
            counts[name] = _counted(judged, len(folder) - judged, folder=str(folder.folder))
    for fit in fits:
        found, num_left_out = fit.open(frozenset().union(*learnt))
        for name, views in found.items():
            counts[name] = _counted(len(views), num_left_out, run_id=fit.run_id)
            if len(views):
                sources[name] = views
    if not sources:
        raise DataError(f"a painter was trained on every held-out view of {', '.join(counts)}")
    return sources, counts


def _counted(num_judged: int, num_left_out: int, **origin: str) -> dict[str, Any]:
    return {**origin, "num_judged": num_judged, "num_left_out": num_left_out}
