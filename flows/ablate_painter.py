"""Painters that differ in one thing, trained on the same pairs at the same budget, judged alike."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from prefect import flow
from pydantic import BaseModel, ConfigDict

from catalog.store import open_store
from flows.train_painter import training_cost
from lidarpainter_models.devices import Device, chosen_device
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.painter_training import TrainingRequest
from lidarpainter_models.painter.baselines import OverlayPainter, UnpaintedPainter, WarpPainter
from lidarpainter_models.painter.nano.ablations import REFERENCE, ablation_tables
from lidarpainter_models.painter.nano.training import NanoTrainingConfig
from lidarpainter_models.training_data.pairs import named_sets, open_sets
from tasks.painter.evaluate import score_painters
from tasks.painter.train import train, weights_path

UNLEARNED = (UnpaintedPainter.name, OverlayPainter.name, WarpPainter.name)

Tables = Mapping[str, Mapping[str, NanoTrainingConfig]]


class AblationParameters(BaseModel):
    """What to learn from, what to judge by, and what to vary."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    train_folders: tuple[Path, ...]
    test_folders: tuple[Path, ...]
    training: NanoTrainingConfig = NanoTrainingConfig()
    """The recipe in which one thing is varied."""
    chosen: tuple[str, ...] | None = None
    """Names of the tables that are made; None makes all."""
    feature_weights: Path | None = None
    device: Device = "auto"


@flow(name="ablate_painter")
def ablate_painter(parameters: AblationParameters, store_path: Path) -> dict[str, Any]:
    """Train every recipe once and judge it beside the painters that learn nothing."""
    learnt = named_sets(parameters.train_folders)
    device = str(chosen_device(parameters.device))
    rows, recipes = _distinct(_tables(parameters))
    painters = {name: name for name in UNLEARNED}
    costs = {}
    for label, config in recipes.items():
        request = TrainingRequest(sets=learnt, config=config, device=device)
        trained = train(store_path, f"train {label}", request)
        painters[label] = str(weights_path(open_store(store_path), trained.ref))
        costs[label] = training_cost(trained)
    judged = score_painters(
        painters,
        named_sets(parameters.test_folders),
        feature_weights=parameters.feature_weights,
        device=device,
    )
    rules = {name: name for name in UNLEARNED}
    return {
        **judged,
        "tables": {name: rules | labels for name, labels in rows.items()},
        "weights": {label: painters[label] for label in costs},
        "training": costs,
    }


def check_ablation(parameters: AblationParameters) -> None:
    """Find what is missing before an hour of training.

    Raises:
        ConfigError: no such table, or pairs without the reference image that a painter is shown.
        DataError: a folder holds no pairs.
    """
    _, recipes = _distinct(_tables(parameters))
    shown = [name for name, one in recipes.items() if REFERENCE in one.network.inputs]
    for folders in (parameters.train_folders, parameters.test_folders):
        for name, folder in open_sets(named_sets(folders)).items():
            bare = folder.first_without("reference_rgb") if shown else None
            if bare is not None:
                raise ConfigError(
                    f"pairs {name!r}: {bare} holds no nearest recorded image, which "
                    f"{shown[0]} is shown: harvest it again, or choose another --table than inputs"
                )


def _tables(parameters: AblationParameters) -> Tables:
    """The recipes of the chosen tables."""
    training = parameters.training
    tables = {
        name: {row: replace(training, network=network) for row, network in networks.items()}
        for name, networks in ablation_tables(training.network).items()
    }
    for name in parameters.chosen or ():
        if name not in tables:
            raise ConfigError(f"no ablation {name!r}, expected {', '.join(tables)}")
    return {name: tables[name] for name in parameters.chosen or tables}


def _distinct(tables: Tables) -> tuple[dict[str, dict[str, str]], dict[str, NanoTrainingConfig]]:
    """Every recipe once, under the label of its first row; and that label by table and row."""
    recipes: dict[str, NanoTrainingConfig] = {}
    rows: dict[str, dict[str, str]] = {}
    for name, table in tables.items():
        rows[name] = {}
        for row, recipe in table.items():
            known = [label for label, one in recipes.items() if one == recipe]
            rows[name][row] = known[0] if known else row
            recipes.setdefault(rows[name][row], recipe)
    return rows, recipes
