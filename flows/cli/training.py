"""Run the flows behind `lidarpainter painter`, with a Prefect server and progress on stderr."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from catalog.folders import make_writable
from catalog.store import open_store
from flows.ablate_painter import AblationParameters, ablate_painter, check_ablation
from flows.cli.output import say_status
from flows.cli.progress import shown_progress
from flows.painter_parameters import HarvestParameters, TrainPainterParameters
from flows.server import prefect_server
from flows.train_painter import (
    check_harvest,
    check_sources,
    harvest_pairs,
    train_painter,
    write_painter,
)
from lidarpainter_models.painter.known_painters import WEIGHTS_SUFFIX

Parameters = TypeVar("Parameters")


def run_harvest(parameters: HarvestParameters) -> dict[str, Any]:
    """Harvest into the store."""
    check_harvest(parameters, open_store().address)
    return _run(harvest_pairs, parameters)


def run_training(parameters: TrainPainterParameters, out: Path | None) -> dict[str, Any]:
    """Train into the store, and copy the painter out of it if a place is given.

    What cannot be trained on, or written to, is refused before any work begins.
    """
    check_sources(parameters, open_store().address)
    if out is not None:
        make_writable(out.parent if out.suffix == WEIGHTS_SUFFIX else out, "--out")
    result = _run(train_painter, parameters)
    if out is None:
        return result
    return result | write_painter(Path(result["weights"]), result["record"], out)


def run_ablation(parameters: AblationParameters) -> dict[str, Any]:
    """Train and judge every recipe."""
    check_ablation(parameters)
    return _run(ablate_painter, parameters)


def _run(flow: Callable[..., dict[str, Any]], parameters: Parameters) -> dict[str, Any]:
    store = open_store()
    store.make()
    say_status("starting Prefect's server")
    with prefect_server(store.root / "logs" / "prefect.log"), shown_progress():
        return flow(parameters, store.address)
