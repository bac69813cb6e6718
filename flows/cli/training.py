"""Run the flows behind `lidarpainter painter`; imported when such a command runs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from catalog.store import open_store
from flows.ablate_painter import AblationParameters, ablate_painter, check_ablation
from flows.cli.progress import shown_progress
from flows.cli.shared_options import parse_names
from flows.parameters import view_parameters
from flows.server import prefect_server
from flows.train_painter import (
    HarvestParameters,
    TrainPainterParameters,
    check_sources,
    harvest_pairs,
    named_sets,
    train_painter,
)
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.metrics.lpips import LpipsFiles
from lidarpainter_models.painter import PainterChoice
from tasks.painter.judge import judge_painters
from tasks.painter.judged_fits import JudgedFit
from tasks.painter.students import recipe_for
from tasks.runs import open_run

PREFECT_LOG = Path("logs") / "prefect.log"


def harvest_parameters(
    seeds: tuple[int, ...], scenes: Sequence[str] | None, split: str, cameras: str | None
) -> HarvestParameters:
    """What to harvest.

    Raises:
        ConfigError: nothing.
    """
    if not seeds and not scenes:
        raise ConfigError("nothing to harvest: expected --seeds or --scene")
    return HarvestParameters(
        street_seeds=seeds,
        scenes=tuple(scenes or ()),
        split=split,
        cameras=parse_names(cameras),
    )


def train_parameters(
    seeds: tuple[int, ...],
    scenes: Sequence[str] | None,
    split: str,
    cameras: str | None,
    pair_folders: tuple[Path, ...],
) -> TrainPainterParameters:
    """What to train on."""
    return TrainPainterParameters(
        street_seeds=seeds,
        scenes=tuple(scenes or ()),
        split=split,
        cameras=parse_names(cameras),
        pair_folders=pair_folders,
    )


def first_choices(
    base: str | None, start: Path | None, lpips_backbone: Path | None, lpips_heads: Path | None
) -> dict[str, Any]:
    """What is trained and where it starts, as parameters; the small painter unless said.

    Args:
        base: a model for the one-step painter, with a preset after a colon.
        start: weights to go on from, of either painter.
        lpips_backbone: for the loss of the one-step painter.
        lpips_heads: the other half of the same.

    Raises:
        ConfigError: both a model and weights, or no such preset.
        WeightsError: the weights cannot be used.
    """
    if base is not None and start is not None:
        raise ConfigError("give --base or --start, not both: weights name their model themselves")
    model = base
    if start is not None and PainterChoice.of(start).is_one_step:
        model = str(start)
    lpips = LpipsFiles(backbone=lpips_backbone, heads=lpips_heads)
    if model is None:
        if lpips != LpipsFiles():
            raise ConfigError("--lpips-backbone and --lpips-heads are for training with --base")
        return {} if start is None else {"start": start}
    return {"base": model, "lpips": lpips, "training": recipe_for(model)}


def ablation_parameters(
    train_folders: tuple[Path, ...],
    test_folders: tuple[Path, ...],
    tables: tuple[str, ...] | None = None,
) -> AblationParameters:
    """What to learn from, what to judge by, and which tables are wanted; None makes all."""
    return AblationParameters(train_folders=train_folders, test_folders=test_folders, tables=tables)


def run_harvest(parameters: HarvestParameters) -> dict[str, Any]:
    """Harvest into the store."""
    store = open_store()
    with prefect_server(store.root / PREFECT_LOG), shown_progress():
        return harvest_pairs(parameters, store.root)


def run_training(parameters: TrainPainterParameters) -> dict[str, Any]:
    """Train into the store; what cannot be trained on is refused before any work begins."""
    check_sources(parameters)
    store = open_store()
    with prefect_server(store.root / PREFECT_LOG), shown_progress():
        return train_painter(parameters, store.root)


def run_ablation(parameters: AblationParameters) -> dict[str, Any]:
    """Train and judge every variant."""
    check_ablation(parameters)
    store = open_store()
    with prefect_server(store.root / PREFECT_LOG), shown_progress():
        return ablate_painter(parameters, store.root)


def judge(
    painters: Sequence[Path],
    pair_folders: Sequence[Path],
    feature_weights: Path | None,
    keep_below: float | None = None,
    runs: Sequence[str] = (),
) -> dict[str, Any]:
    """Judge painters here and now; nothing is stored.

    Raises:
        ConfigError: neither pairs nor runs to judge by.
    """
    if not pair_folders and not runs:
        raise ConfigError("nothing to judge by: expected --pairs or --run")
    labels = {str(painter): str(painter) for painter in painters}
    fits = [judged_fit(run) for run in runs]
    with shown_progress():
        return judge_painters.fn(
            labels, named_sets(pair_folders), feature_weights, keep_below, fits
        )


def judged_fit(run: str) -> JudgedFit:
    """The first fit of a finished run, and the views that it was not fitted to.

    Raises:
        UnknownRecordError: there is no such run, or it did not complete.
    """
    store = open_store()
    finished = open_run(store, run)
    parameters = view_parameters(finished)
    return JudgedFit(
        store_path=store.root,
        run_id=finished.run_id,
        split=parameters.split_spec,
        fitted=finished.unpainted,
        settings=parameters.judge_config,
    )
