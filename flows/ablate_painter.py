"""Painters that differ in one thing, trained on the same pairs at the same budget, judged alike."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from prefect import flow
from pydantic import BaseModel, ConfigDict

from catalog.store import open_store
from flows.train_painter import named_sets, training_cost
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.metrics.lpips import LpipsFiles
from lidarpainter_models.painter import OverlayPainter, UnpaintedPainter, WarpPainter
from lidarpainter_models.painter.nano.ablations import REFERENCE, ablation_tables
from lidarpainter_models.painter.nano.training import NanoTrainingConfig
from lidarpainter_models.painter.one_step.training import OneStepTrainingConfig
from lidarpainter_models.painter.one_step.variants import ablations, distinct
from tasks.painter.judge import judge_painters, open_sets
from tasks.painter.students import PainterTraining, student_of
from tasks.painter.train import WEIGHTS_SUFFIX, train, weights_path

_Table = TypeVar("_Table")
UNLEARNED = (UnpaintedPainter.name, OverlayPainter.name, WarpPainter.name)


class AblationParameters(BaseModel):
    """What to learn from, what to judge by, and what to vary."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    train_folders: tuple[Path, ...]
    test_folders: tuple[Path, ...]
    tables: tuple[str, ...] | None = None
    """Which choices are varied, see `nano.ablations` and `one_step.variants`; None varies all."""
    base: str | None = None
    """Model that one-step painters are trained on; None trains small painters."""
    training: PainterTraining = NanoTrainingConfig()
    lpips: LpipsFiles = LpipsFiles()
    """Weights for the loss of the one-step painter."""
    feature_weights: Path | None = None


@flow(name="ablate_painter")
def ablate_painter(parameters: AblationParameters, store_path: Path) -> dict[str, Any]:
    """Train every variant once and judge it beside the painters that learn nothing."""
    learnt = named_sets(parameters.train_folders)
    tables, variants = _varied(parameters)
    painters = {name: name for name in UNLEARNED}
    costs = {}
    for label, config in variants.items():
        stage = f"train {label}"
        trained = train(store_path, stage, learnt, config, 0.0, parameters.base, parameters.lpips)
        painters[label] = str(weights_path(open_store(store_path), trained.ref))
        costs[label] = training_cost(trained)
    judged = judge_painters(
        painters, named_sets(parameters.test_folders), parameters.feature_weights
    )
    rules = {name: name for name in UNLEARNED}
    return {
        **judged,
        "tables": {name: rules | rows for name, rows in tables.items()},
        "weights": {label: painters[label] for label in costs},
        "training": costs,
    }


def check_ablation(parameters: AblationParameters) -> None:
    """Find what is missing before an hour of training.

    Raises:
        ConfigError: no such table, a weights file in place of a model, a loss that lacks what it
            weighs, or pairs without the reference image that a variant is shown.
        DataError: a folder holds no pairs.
        WeightsError: the model cannot be used.
    """
    if parameters.base is not None and parameters.base.endswith(WEIGHTS_SUFFIX):
        raise ConfigError("an ablation wires a model in many ways; a weights file has its own")
    student_of(parameters.training, parameters.base, parameters.lpips)
    _, variants = _varied(parameters)
    shown = [name for name, one in variants.items() if REFERENCE in one.network.inputs]
    for folders in (parameters.train_folders, parameters.test_folders):
        for name, folder in open_sets(named_sets(folders)).items():
            bare = folder.first_without("reference_rgb") if shown else None
            if bare is not None:
                raise ConfigError(
                    f"pairs {name!r}: {bare} holds no nearest recorded image, which "
                    f"{shown[0]} is shown: harvest it again, or choose another --table than inputs"
                )


def _varied(
    parameters: AblationParameters,
) -> tuple[dict[str, dict[str, str]], dict[str, PainterTraining]]:
    """The painters' labels by table and row, and what is trained by label, each once."""
    training = parameters.training
    if isinstance(training, OneStepTrainingConfig):
        wirings = _chosen(ablations(training.network), parameters.tables)
        once = distinct(wirings)
        labels = {wiring: label for label, wiring in once.items()}
        rows = {
            name: {f"{name}: {value}": labels[wiring] for value, wiring in choices.items()}
            for name, choices in wirings.items()
        }
        return rows, {label: replace(training, network=one) for label, one in once.items()}
    networks = _chosen(ablation_tables(training.network), parameters.tables)
    rows = {name: {label: label for label in variants} for name, variants in networks.items()}
    return rows, {
        label: replace(training, network=network)
        for variants in networks.values()
        for label, network in variants.items()
    }


def _chosen(tables: dict[str, _Table], names: Iterable[str] | None) -> dict[str, _Table]:
    for name in names or ():
        if name not in tables:
            raise ConfigError(f"no ablation {name!r}, expected {', '.join(tables)}")
    return tables if names is None else {name: tables[name] for name in names}
