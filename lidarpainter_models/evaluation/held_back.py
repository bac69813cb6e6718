"""Keep what a painter learns from apart from what judges it.

A pair aims at a true image, its target; the same target can stand in many pairs (several fits,
damaged copies, several folders). So pairs are held back, and compared with a painter's training
record, by target and never by file. Synthetic streets of low seeds are for judging only.
"""

import hashlib
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any

import torch

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.painter.examples import PaintingPair, Window
from lidarpainter_models.painter.nano.painter import NanoPainter
from lidarpainter_models.painter.one_step.painter import OneStepPainter
from lidarpainter_models.painter.protocol import Painter
from lidarpainter_models.painter.training.job import TrainingJob
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.synthetic.street import SyntheticStreet
from lidarpainter_models.training_data.pairs import PairFolder

FIRST_TRAINING_SEED = 1000
"""Streets of lower seeds belong to the demo, the tests and the evaluation."""
TARGETS_KEY = "trained_targets"
"""Entry of a weights file's provenance: the targets its training saw."""
_COPY = re.compile(r"-(fit|damaged\d+)$")
_STREET = re.compile(r"street-(\d+)$")


class PairSubset:
    """Some pairs of a folder, in its order; a `PairSource`."""

    def __init__(self, folder: PairFolder, name: str, indices: Sequence[int]) -> None:
        """Choose pairs by position; `name` is what records call the set."""
        self.folder = folder
        self.set_name = name
        self.indices = tuple(indices)

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def digest(self) -> str:
        """SHA-256 of the folder's digest and of what was chosen from it."""
        chosen = json.dumps([self.folder.digest, self.indices])
        return hashlib.sha256(chosen.encode()).hexdigest()

    @property
    def targets(self) -> frozenset[str]:
        """The true images that the pairs aim at."""
        return frozenset(target_of(self.folder, index) for index in self.indices)

    def size_px(self, index: int) -> tuple[int, int]:
        """Height and width of a pair."""
        return self.folder.size_px(self.indices[index])

    def read(self, index: int, window: Window | None = None) -> PaintingPair:
        """A pair, or the part of it inside a window.

        Raises:
            DataError: the file is damaged.
        """
        return self.folder.read(self.indices[index], window)

    def describe(self) -> dict[str, Any]:
        """The digest and what every pair came from."""
        folder = self.folder
        pairs = {folder.name(index): folder.provenance(index) for index in self.indices}
        return {"set": self.set_name, "digest": self.digest, "pairs": pairs}


def target_of(folder: PairFolder, index: int) -> str:
    """The true image of a pair: data set, sequence, and what was photographed from where."""
    return target_name(folder.name(index), folder.provenance(index))


def target_name(pair: str, provenance: Mapping[str, Any]) -> str:
    """What a pair's true image is called.

    A pair whose provenance does not say what it shows has a target of its own, shared with its
    damaged copies.
    """
    place = f"{provenance.get('dataset', 'unknown')}/{provenance.get('sequence', 'unknown')}"
    if "target" in provenance:
        return f"{place} {json.dumps(provenance['target'])}"
    if "frame" in provenance and "shift" in provenance:
        camera = provenance.get("cameras", [None])[0]
        return f"{place} {json.dumps([provenance['frame'], camera, provenance['shift']])}"
    return f"{place} {_COPY.sub('', pair)}"


def target_view(target: str) -> tuple[str, int, str] | None:
    """Scene, frame and camera of a target, wherever the camera stood; None if it says none."""
    scene_id, _, described = target.partition(" ")
    try:
        match json.loads(described):
            case [int(frame), str(camera), *_]:
                return scene_id, frame, camera
    except ValueError:
        pass
    return None


def trained_targets(provenance: Mapping[str, Any]) -> frozenset[str] | None:
    """The true images that weights were trained on, or None if they do not say.

    Weights say it by a list of targets, or by describing every pair of their sources.
    """
    if TARGETS_KEY in provenance:
        return frozenset(provenance[TARGETS_KEY])
    described = [source.get("pairs") for source in provenance.get("sources", ())]
    if not described or not all(isinstance(pairs, Mapping) for pairs in described):
        return None
    return frozenset(
        target_name(pair, known) for pairs in described for pair, known in pairs.items()
    )


def learnt_targets(painter: Painter) -> frozenset[str] | None:
    """What a painter was trained on; nothing for one that learns nothing, None if unknown."""
    if isinstance(painter, NanoPainter | OneStepPainter):
        return trained_targets(painter.provenance)
    return frozenset()


def first_targets(job: TrainingJob) -> frozenset[str]:
    """What the first weights of a training have learnt.

    Raises:
        ConfigError: they do not say.
    """
    if job.first_provenance is None:
        return frozenset()
    learnt = trained_targets(job.first_provenance)
    if learnt is None:
        raise ConfigError("the first weights: expected such as say what they have learnt")
    return learnt


def check_street_seed(seed: int) -> None:
    """Refuse to train on a street that judges.

    Raises:
        ConfigError: the seed is below `FIRST_TRAINING_SEED`.
    """
    if seed < FIRST_TRAINING_SEED:
        raise ConfigError(
            f"street seed {seed} is kept for the demo, tests and judging: painters train on seeds "
            f"from {FIRST_TRAINING_SEED} up"
        )


def check_training_scene(dataset: str, sequence: str) -> None:
    """Refuse to train on a stored street that judges.

    Raises:
        ConfigError: see `check_street_seed`.
    """
    found = _STREET.fullmatch(sequence)
    if dataset == "synthetic" and found:
        check_street_seed(int(found[1]))


def check_training_pairs(folder: PairFolder) -> None:
    """Refuse to train on no pairs, or on those of a street that judges.

    Raises:
        DataError: the folder holds none.
        ConfigError: see `check_street_seed`.
    """
    if not len(folder):
        raise DataError(f"no training pairs in {folder.folder}: its index is empty")
    for index in range(len(folder)):
        provenance = folder.provenance(index)
        dataset, sequence = (str(provenance.get(key)) for key in ("dataset", "sequence"))
        check_training_scene(dataset, sequence)


def hold_back(
    folders: Mapping[str, PairFolder], share: float, *, known: Set[str] = frozenset()
) -> tuple[dict[str, PairSubset], dict[str, PairSubset]]:
    """Part the pairs into those to learn from and those to judge by; no target is in both.

    Of every folder's targets the same share is held back, chosen by a digest of their names, so
    neither the order nor the other folders matter. Targets `known` from before judge nothing if
    they are held back.

    Returns:
        Pairs to learn from and pairs to judge by, by name; empty sets are left out.

    Raises:
        ConfigError: the share is outside [0, 1), or nothing is left to learn from.
    """
    if not 0 <= share < 1:
        raise ConfigError(f"the share of pairs held back must be in [0, 1), got {share}")
    held: set[str] = set()
    for folder in folders.values():
        targets = {target_of(folder, index) for index in range(len(folder))}
        count = math.ceil(share * len(targets)) if len(targets) > 1 else 0
        held.update(sorted(targets, key=_mixed)[:count])
    learnt = _aiming(folders, lambda target: target not in held)
    if folders and not learnt:
        raise ConfigError(f"with a share of {share} held back no pair is left to learn from")
    return learnt, _aiming(folders, lambda target: target in held and target not in known)


def _aiming(
    folders: Mapping[str, PairFolder], is_wanted: Callable[[str], bool]
) -> dict[str, PairSubset]:
    """The pairs that aim at wanted targets; empty sets are left out."""
    found = {}
    for name, folder in folders.items():
        indices = [index for index in range(len(folder)) if is_wanted(target_of(folder, index))]
        if indices:
            found[name] = PairSubset(folder, name, indices)
    return found


def unseen_pairs(
    folders: Mapping[str, PairFolder], known: Iterable[frozenset[str]]
) -> dict[str, PairSubset]:
    """The pairs that no painter was trained on, so that all of them are judged alike.

    Raises:
        DataError: every pair's target was trained on.
    """
    learnt = frozenset().union(*known)
    unseen = _aiming(folders, lambda target: target not in learnt)
    if not unseen:
        raise DataError(
            f"no pair of {', '.join(folders) or 'no folder'} is left to judge by: a painter was "
            "trained on the target of every one"
        )
    return unseen


def _mixed(target: str) -> str:
    return hashlib.sha256(target.encode()).hexdigest()


RECORDED = "recorded"
"""Name of the held-out frames at interpolated poses."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOutPairs:
    """The held-out views of one trajectory; conditions are gathered when a pair is read."""

    builder: ConditionBuilder
    """With the scene whose render is painted."""
    held_out: HeldOut
    beside: tuple[SyntheticStreet, Shift] | None = None
    """The world and where in it; None for the recorded images."""

    def __len__(self) -> int:
        return len(self.held_out.test_views)

    def read(self, index: int) -> PaintingPair:
        """The pair of a held-out view; its target is known but for the recording car."""
        view = self.held_out.test_views[index]
        alone, fitted = replace(self.held_out, test_views=[view]), self.builder.scene
        if self.beside is None:
            (judged,) = alone.recorded_views(fitted, "interpolated")
        else:
            (judged,) = alone.synthetic_views(fitted, *self.beside)
        conditions = self.builder.conditions(
            judged.camera, judged.timestamp_ns, camera_name=view.camera_name
        )
        truth = judged.truth_rgb.clamp(0, 1)
        everywhere = torch.ones(truth.shape[:2], dtype=torch.bool)
        known = everywhere if judged.hidden is None else ~judged.hidden
        return PaintingPair(conditions=conditions, target_rgb=truth, target_valid=known)


def held_out_pairs(
    builder: ConditionBuilder,
    held_out: HeldOut,
    street: SyntheticStreet | None,
    shifts: Sequence[Shift],
) -> dict[str, HeldOutPairs]:
    """The pairs of a scene by trajectory: at the shifts of a street, else as recorded."""
    if street is None:
        return {RECORDED: HeldOutPairs(builder=builder, held_out=held_out)}
    return {
        shift.name: HeldOutPairs(builder=builder, held_out=held_out, beside=(street, shift))
        for shift in shifts
    }


def unseen_views(
    views: Sequence[RecordedView], scene_id: str, trained: Set[str]
) -> list[RecordedView]:
    """The views of a scene of which no painter was trained on an image, from whatever place.

    `trained` holds targets that painters were trained on (`held_back.target_of`).
    """
    known = {target_view(target) for target in trained}
    return [view for view in views if (scene_id, view.frame_index, view.camera_name) not in known]
