"""Judge painters on stored pairs and held-out views that none of them was trained on."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch

from catalog.artefacts import ArtefactRef, Workplace
from catalog.digests import DIGEST_LENGTH, digest_file
from catalog.store import Store, open_store
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.held_back import PairSubset, hold_back, learnt_targets
from lidarpainter_models.evaluation.painting import ScoringPairs, painting_samples, score_painter
from lidarpainter_models.export.images import write_png
from lidarpainter_models.metrics.backbones import SqueezeNetDistance, load_squeezenet_distance
from lidarpainter_models.painter.nano.painter import NanoPainter
from lidarpainter_models.painter.precision import precision_of
from lidarpainter_models.painter.protocol import Painter
from lidarpainter_models.painter.selection import PainterChoice
from lidarpainter_models.training_data.pairs import PairSet, open_sets
from tasks.json_files import read_json, write_json
from tasks.measuring import measured
from tasks.painter.held_out_fits import HeldOutFit, unseen_sources
from tasks.progress import Progress, listener, progress_of
from tasks.stages import StageResult, run_stage, stage_task

SCORES_FILE = "painting-scores.json"
SAMPLES_FILE = "samples.png"


@stage_task
def score_painters(
    painters: Mapping[str, str],
    sets: Sequence[PairSet],
    fits: Sequence[HeldOutFit] = (),
    *,
    feature_weights: Path | None = None,
    keep_below: float | None = None,
    device: str = "cpu",
) -> dict[str, Any]:
    """Scores of several painters on the same pairs, those left out that any was trained on.

    Painters are names or weights files by what tables call them. Held-out views of the `fits` are
    judged as pairs too. With `keep_below` the small painter is judged a second time, leaving tiles
    unpainted on which all that is known differs by less than this.

    Returns:
        `painters`: scores by label; `pairs`: how many of every set were judged and left out;
        `training_unknown`: learned painters whose weights do not say what they were trained on.
    """
    distance = feature_distance_of(feature_weights)
    choices = {label: PainterChoice.of(name) for label, name in painters.items()}
    place = torch.device(device)
    # one at a time: several at full size do not fit into memory
    known = {label: learnt_targets(choice.load(place)) for label, choice in choices.items()}
    learnt = [targets for targets in known.values() if targets is not None]
    unseen, pairs = unseen_sources(sets, fits, learnt)
    scores: dict[str, Any] = {}
    sparing: dict[str, Any] = {}
    for label, choice in choices.items():
        painter = choice.load(place)
        scores[label] = _told_scores(painter, unseen, distance, f"judge {label}")
        if keep_below is not None and isinstance(painter, NanoPainter):
            twice = f"{label}, tiles kept"
            again = painter.sparing(keep_below)
            sparing[twice] = _told_scores(again, unseen, distance, f"judge {twice}")
    return {
        "painters": scores | sparing,
        "pairs": pairs,
        "training_unknown": [label for label, targets in known.items() if targets is None],
    }


@stage_task
def score_held_back(
    store_path: Path,
    stage: str,
    weights: Path,
    sets: Sequence[PairSet],
    held_back: float,
    *,
    feature_weights: Path | None = None,
    device: str = "cpu",
) -> StageResult:
    """Scores of a freshly trained painter on its validation split.

    Raises:
        ConfigError: nothing was held back.
    """
    choice = PainterChoice.of(weights)
    known = learnt_targets(choice.load(torch.device(device))) or frozenset()
    _, judged = hold_back(open_sets(sets), held_back, known=known)
    if not judged:
        raise ConfigError("no pairs were held back, so there is nothing to judge by")
    inputs = {"painter": choice.digest}
    inputs |= {f"pairs {name}": subset.digest for name, subset in judged.items()}
    if feature_weights is not None:
        inputs["features"] = digest_file(feature_weights)[:DIGEST_LENGTH]
    return run_stage(
        open_store(store_path),
        stage=stage,
        kind="evaluation",
        inputs=inputs,
        config={"held_back": held_back},
        build=partial(
            _build_scores,
            weights=weights,
            judged=judged,
            feature_weights=feature_weights,
            device=device,
        ),
    )


def _build_scores(
    place: Workplace,
    progress: Progress,
    *,
    weights: Path,
    judged: Mapping[str, PairSubset],
    feature_weights: Path | None,
    device: str,
) -> dict[str, Any]:
    painter = PainterChoice.of(weights).load(torch.device(device))
    scores = _scores(painter, judged, feature_distance_of(feature_weights), progress)
    write_json(place.output / SCORES_FILE, scores)
    write_png(painting_samples(painter, judged), place.output / SAMPLES_FILE)
    total = scores["total"]
    return {
        "num_pairs": total["num_pairs"],
        "psnr_input": total["input"]["psnr"],
        "psnr_painted": total["painted"]["psnr"],
        "precision": precision_of(painter),
    }


def load_painting_scores(store: Store, ref: ArtefactRef) -> dict[str, Any]:
    """Read the scores of `score_held_back`."""
    return read_json(store.artefacts.files(ref) / SCORES_FILE)


def samples_path(store: Store, ref: ArtefactRef) -> Path:
    """The images that `score_held_back` has painted: render, LiDAR, painted, true."""
    return store.artefacts.files(ref) / SAMPLES_FILE


def feature_distance_of(weights: Path | None) -> SqueezeNetDistance | None:
    """The feature distance, if there are weights for it."""
    return None if weights is None else load_squeezenet_distance(weights)


def _told_scores(
    painter: Painter,
    sources: Mapping[str, ScoringPairs],
    distance: SqueezeNetDistance | None,
    stage: str,
) -> dict[str, Any]:
    """Scores that are not stored, so the listener is told here and not by `run_stage`."""
    listener().started(stage)
    with measured() as cost:
        scores = _scores(painter, sources, distance, progress_of(stage))
    listener().finished(stage, cost.seconds, is_new=True)
    return scores


def _scores(
    painter: Painter,
    sources: Mapping[str, ScoringPairs],
    distance: SqueezeNetDistance | None,
    progress: Progress,
) -> dict[str, Any]:
    found = score_painter(painter, sources, feature_distance=distance, progress=progress)
    return asdict(found)
