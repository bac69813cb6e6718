"""Run the flows behind `lidarpainter painter`; imported when such a command runs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from catalog.store import open_store
from flows.cli.ingest import parse_names
from flows.cli.progress import shown_progress
from flows.server import prefect_server
from flows.train_painter import (
    AblationParameters,
    HarvestParameters,
    TrainPainterParameters,
    ablate_painter,
    check_ablation,
    check_sources,
    harvest_pairs,
    named_sets,
    train_painter,
)
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.nano.ablations import TABLE_NAMES
from tasks.judge_painter import judge_painters

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
    start: Path | None = None,
) -> TrainPainterParameters:
    """What to train on; refused before any work begins.

    Raises:
        ConfigError: nothing, or what judges painters.
        DataError: a folder holds no pairs.
        WeightsError: the first weights cannot be used.
    """
    parameters = TrainPainterParameters(
        street_seeds=seeds,
        scenes=tuple(scenes or ()),
        split=split,
        cameras=parse_names(cameras),
        pair_folders=pair_folders,
        start=start,
    )
    check_sources(parameters)
    return parameters


def ablation_parameters(
    train_folders: tuple[Path, ...],
    test_folders: tuple[Path, ...],
    tables: tuple[str, ...] | None = None,
) -> AblationParameters:
    """What to learn from, what to judge by, and which tables are wanted; None makes all."""
    return AblationParameters(
        train_folders=train_folders, test_folders=test_folders, tables=tables or TABLE_NAMES
    )


def run_harvest(parameters: HarvestParameters) -> dict[str, Any]:
    """Harvest into the store."""
    store = open_store()
    with prefect_server(store.root / PREFECT_LOG), shown_progress():
        return harvest_pairs(parameters, store.root)


def run_training(parameters: TrainPainterParameters) -> dict[str, Any]:
    """Train into the store."""
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
) -> dict[str, Any]:
    """Judge painters here and now; nothing is stored."""
    labels = {str(painter): str(painter) for painter in painters}
    with shown_progress():
        return judge_painters.fn(labels, named_sets(pair_folders), feature_weights, keep_below)
