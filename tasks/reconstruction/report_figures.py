"""Tables and curves of the page about a run."""

from collections.abc import Mapping
from typing import Any

from lidarpainter_models.export.report import Cell, Plot, Table
from tasks.evaluation.scores import SCORE_COLUMNS, SCORE_NOTE, score_rows
from tasks.stages import StageResult
from tasks.stored import load_history

MEGABYTE = 1e6
GUIDANCE_COLUMNS = ("num_cameras", "num_without_room", "num_refused", "num_views", "mean_weight")


def tables(result: Mapping[str, Any], stages: Mapping[str, StageResult]) -> list[Table]:
    """Scores, stages and painted views of a run."""
    costs: list[list[Cell]] = [
        [
            name,
            stage.seconds,
            stage.cpu_seconds,
            stage.peak_memory_bytes / MEGABYTE,
            stage.ref.digest,
        ]
        for name, stage in stages.items()
    ]
    guidance = [
        [name, *(values[key] for key in GUIDANCE_COLUMNS)]
        for name, values in result["guidance"].items()
    ]
    tables = [
        Table(
            title="Held-out views",
            columns=SCORE_COLUMNS,
            rows=score_rows(result),
            note=SCORE_NOTE,
        ),
        Table(
            title="Stages",
            columns=["stage", "seconds", "CPU seconds", "peak memory, MB", "artefact"],
            rows=costs,
            note="As computed; a stage that was there already keeps the time it took then.",
        ),
    ]
    if guidance:
        tables.append(
            Table(title="Painted views", columns=["round", *GUIDANCE_COLUMNS], rows=guidance)
        )
    return tables


def plots(stages: Mapping[str, StageResult]) -> list[Plot]:
    """The course of every fit of a run."""
    histories = {
        name: load_history(stage.ref)
        for name, stage in stages.items()
        if stage.ref.kind == "gaussians"
    }

    def lines(key: str) -> dict[str, list[tuple[float, float]]]:
        return {
            name: [(entry["step"], entry[key]) for entry in history]
            for name, history in histories.items()
        }

    return [
        Plot(title="Training views", x_label="step", y_label="PSNR, dB", series=lines("psnr")),
        Plot(title="Size", x_label="step", y_label="Gaussians", series=lines("num_gaussians")),
    ]
