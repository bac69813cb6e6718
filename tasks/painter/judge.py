"""Judge painters on stored pairs and held-out views that none of them was trained on."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from prefect import task

from catalog.artefacts import ArtefactRef, Workplace
from catalog.digests import DIGEST_LENGTH, digest_file
from catalog.store import Store, open_store
from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.evaluation.held_back import hold_back, trained_targets, unseen_pairs
from lidarpainter_models.evaluation.painting import JudgingPairs, score_painter
from lidarpainter_models.metrics.squeezenet import SqueezeNetDistance, load_squeezenet_distance
from lidarpainter_models.painter import load_painter
from lidarpainter_models.painter.nano.painter import NanoPainter
from lidarpainter_models.painter.nano.tiles import TileConfig
from lidarpainter_models.painter.one_step.painter import OneStepPainter
from lidarpainter_models.painter.protocol import Painter
from lidarpainter_models.training_data.pairs import PairFolder
from tasks.json_files import read_json, write_json
from tasks.measuring import measured
from tasks.painter.harvest import PairSet
from tasks.painter.judged_fits import JudgedFit, open_fits
from tasks.painter.painting_samples import write_samples
from tasks.progress import Progress, listener
from tasks.stages import STAGE_OPTIONS, StageResult, run_stage

SCORES_FILE = "painting-scores.json"
SAMPLES_FILE = "samples.png"
PAINTING_COLUMNS = (
    "image",
    "PSNR",
    "SSIM",
    "features",
    "damaged",
    "undamaged",
    "outside hull, %",
    "confidence AUC",
    "CPU ms",
    "kept, %",
)
PAINTING_NOTE = (
    "PSNR, damaged and undamaged in dB; damaged: error of the render above 0.1; outside hull: more "
    "than 0.05 beyond what any input shows within 9x9 pixels; AUC: of the confidence for an error "
    "above 0.05; features: SqueezeNet distance, with --feature-weights; kept: left unpainted."
)
FIGURES = ("psnr", "ssim", "feature_distance", "damaged_psnr", "undamaged_psnr")

PaintingCell = str | float | None


@task(**STAGE_OPTIONS)
def judge_painters(
    painters: Mapping[str, str],
    sets: Sequence[PairSet],
    feature_weights: Path | None = None,
    keep_below: float | None = None,
    fits: Sequence[JudgedFit] = (),
) -> dict[str, Any]:
    """Scores of several painters on the same pairs, those left out that any was trained on.

    Args:
        painters: names or weights files of painters, by what tables call them.
        sets: the pairs.
        feature_weights: SqueezeNet 1.1, for the feature distance.
        keep_below: judge the small painter a second time, leaving tiles unpainted on which all that
            is known differs by less than this.
        fits: runs whose held-out views are judged as pairs too.

    Returns:
        `painters`: scores by label; `pairs`: how many of every set were judged and left out;
        `training_unknown`: learned painters whose weights do not say what they were trained on.
    """
    tiles = None if keep_below is None else TileConfig(keep_below=keep_below)
    distance = feature_distance_of(feature_weights)
    # one at a time: several at full size do not fit into memory
    known = {label: _trained_targets(load_painter(name)) for label, name in painters.items()}
    learnt = [targets for targets in known.values() if targets is not None]
    unseen, pairs = _to_judge_by(sets, fits, learnt)
    scores: dict[str, Any] = {}
    sparing: dict[str, Any] = {}
    for label, name in painters.items():
        painter = load_painter(name)
        scores[label] = _told_scores(painter, unseen, distance, f"judge {label}")
        if tiles is not None and isinstance(painter, NanoPainter):
            twice = f"{label}, tiles kept"
            again = _sparing(painter, tiles)
            sparing[twice] = _told_scores(again, unseen, distance, f"judge {twice}")
    return {
        "painters": scores | sparing,
        "pairs": pairs,
        "training_unknown": [label for label, targets in known.items() if targets is None],
    }


def _to_judge_by(
    sets: Sequence[PairSet], fits: Sequence[JudgedFit], learnt: Sequence[frozenset[str]]
) -> tuple[dict[str, JudgingPairs], dict[str, Any]]:
    """Pairs that no painter was trained on, and how many of every set those are.

    Raises:
        ConfigError: neither pairs nor runs.
        DataError: a painter was trained on all of them.
    """
    sources: dict[str, JudgingPairs] = {}
    counts: dict[str, Any] = {}
    if sets or not fits:
        folders = open_sets(sets)
        unseen = unseen_pairs(folders, learnt)
        sources |= unseen
        for name, folder in folders.items():
            judged = len(unseen.get(name, ()))
            counts[name] = _counted(judged, len(folder) - judged, folder=str(folder.folder))
    for fit in open_fits(fits, frozenset().union(*learnt)):
        for name, views in fit.pairs.items():
            counts[name] = _counted(len(views), fit.num_left_out, run_id=fit.run_id)
            if len(views):
                sources[name] = views
    if not sources:
        raise DataError(f"a painter was trained on every held-out view of {', '.join(counts)}")
    return sources, counts


def _counted(num_judged: int, num_left_out: int, **origin: str) -> dict[str, Any]:
    return {**origin, "num_judged": num_judged, "num_left_out": num_left_out}


@task(**STAGE_OPTIONS)
def judge_held_back(
    store_path: Path,
    stage: str,
    weights: Path,
    sets: Sequence[PairSet],
    held_back: float,
    feature_weights: Path | None = None,
) -> StageResult:
    """Scores of a freshly trained painter on the pairs that its training held back.

    Raises:
        ConfigError: none were held back.
    """
    folders = open_sets(sets)
    known = _trained_targets(load_painter(weights)) or frozenset()
    _, judged = hold_back(folders, held_back, known=known)
    if not judged:
        raise ConfigError("no pairs were held back, so there is nothing to judge by")
    inputs = {"painter": digest_file(weights)[:DIGEST_LENGTH]}
    inputs |= {f"pairs {name}": subset.digest for name, subset in judged.items()}
    distance = feature_distance_of(feature_weights)
    if feature_weights is not None:
        inputs["features"] = digest_file(feature_weights)[:DIGEST_LENGTH]

    def build(place: Workplace, _progress: Progress) -> dict[str, Any]:
        painter = load_painter(weights)
        scores = _scores(painter, judged, distance, stage)
        write_json(place.output / SCORES_FILE, scores)
        write_samples(painter, judged, place.output / SAMPLES_FILE)
        total = scores["total"]
        return {
            "num_pairs": total["num_pairs"],
            "psnr_input": total["input"]["psnr"],
            "psnr_painted": total["painted"]["psnr"],
        }

    return run_stage(
        open_store(store_path),
        stage=stage,
        kind="evaluation",
        inputs=inputs,
        config={"held_back": held_back},
        build=build,
    )


def _sparing(painter: NanoPainter, tiles: TileConfig) -> NanoPainter:
    """The same painter, painting only what needs it."""
    return NanoPainter(
        painter.network,
        provenance=painter.provenance,
        precision=painter.precision,
        tiles=tiles,
    )


def load_painting_scores(store: Store, ref: ArtefactRef) -> dict[str, Any]:
    """Read the scores of `judge_held_back`."""
    return read_json(store.artefacts.folder(ref) / SCORES_FILE)


def samples_path(store: Store, ref: ArtefactRef) -> Path:
    """The images that `judge_held_back` has painted: render, LiDAR, painted, true."""
    return store.artefacts.folder(ref) / SAMPLES_FILE


def open_sets(sets: Sequence[PairSet]) -> dict[str, PairFolder]:
    """Every set by its name.

    Raises:
        ConfigError: no set, or two of one name.
    """
    folders = {one.name: one.open() for one in sets}
    if not sets or len(folders) != len(sets):
        names = ", ".join(one.name for one in sets)
        raise ConfigError(f"need pairs under names of their own, got {names or 'none'}")
    return folders


def feature_distance_of(weights: Path | None) -> SqueezeNetDistance | None:
    """The feature distance, if there are weights for it."""
    return None if weights is None else load_squeezenet_distance(weights)


def _trained_targets(painter: Painter) -> frozenset[str] | None:
    """What a painter was trained on; nothing for one that learns nothing, None if unknown."""
    if isinstance(painter, NanoPainter | OneStepPainter):
        return trained_targets(painter.provenance)
    return frozenset()


def painting_rows(
    scores: Mapping[str, Mapping[str, Any]], source: str | None = None
) -> list[list[PaintingCell]]:
    """A row for the render, one for the mean of the warps, and one per painter.

    Args:
        scores: those of every painter, by label.
        source: the set of pairs to show; None for all together.
    """
    found = {
        label: one["total"] if source is None else one["sources"][source]
        for label, one in scores.items()
    }
    first = next(iter(found.values()))
    rows = [
        [*_figures("input render", first["input"]), None, None, None],
        [*_figures("mean with warps", first["warp_mean"]), None, None, None],
    ]
    for label, one in found.items():
        painted = _figures(label, one["painted"])
        rows.append(
            [*painted, one["confidence_auc"], one["cpu_ms_per_frame"], 100 * one["kept_share"]]
        )
    return rows


def _told_scores(
    painter: Painter,
    sources: Mapping[str, JudgingPairs],
    distance: SqueezeNetDistance | None,
    stage: str,
) -> dict[str, Any]:
    """Scores that are not stored, so the listener is told here and not by `run_stage`."""
    listener().started(stage)
    with measured() as cost:
        scores = _scores(painter, sources, distance, stage)
    listener().finished(stage, cost.seconds, is_new=True)
    return scores


def _scores(
    painter: Painter,
    sources: Mapping[str, JudgingPairs],
    distance: SqueezeNetDistance | None,
    stage: str,
) -> dict[str, Any]:
    def told(done: int, total: int) -> None:
        listener().advanced(stage, done, total, "")

    return score_painter(painter, sources, feature_distance=distance, progress=told).to_dict()


def _figures(label: str, image: Mapping[str, Any]) -> list[PaintingCell]:
    return [label, *(image[name] for name in FIGURES), 100 * image["outside_hull"]]
