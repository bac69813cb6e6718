"""What the sequences of a fleet came to: their cost and every number of their runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from catalog.artefacts import ArtefactRef
from catalog.fleets import FleetLedger
from catalog.records import json_of
from catalog.store import Store
from catalog.tables import Row

JUDGING = ("evaluate", "envelope", "examine", "lidar", "report")
"""Stages that look at a scene and make nothing of it."""
UNPAINTED = "unpainted"
"""The variant of numbers that are of the first fit."""
FINAL = ("painted", "refined")
"""Variants of numbers that are of the scene at the end of its run."""

MetricName = tuple[str, str, str]
"""Protocol, trajectory and name."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """One scene, made in one way with one seed."""

    scene: str
    configuration: str
    seed: int
    run_id: str
    cost: dict[str, float]
    """Cost of the stages that make the scene, as computed, also where it was recalled: seconds,
    cpu_seconds, peak_memory_bytes; num_gaussians and scene_bytes of what they made."""
    metrics: dict[MetricName, float]
    """Numbers of the scene at the end."""
    by_variant: dict[str, dict[MetricName, float]] = field(default_factory=dict)
    """Numbers of every variant that was scored, by its name in the catalog."""
    suspicions: Sequence[str] | None = None
    """What is wrong about the recording, in sentences; None where nobody looked."""


def points_of(store: Store, fleet: str) -> tuple[list[Point], list[Row]]:
    """The points of a fleet that are done, and the sequences that are not.

    Raises:
        UnknownRecordError: there is no such fleet.
        CatalogError: a run's row is damaged.
    """
    sequences = FleetLedger(store).rows(fleet)
    done = {row["run_id"]: row for row in sequences if row["state"] == "done"}
    rows = store.tables.rows
    runs = {row["run_id"]: row for row in rows("runs", where={"run_id": done})}
    scenes = {run_id: _scenes(run)[-1] for run_id, run in runs.items()}
    made = rows("artefacts", where={"artefact_id": set(scenes.values())})
    sizes = {row["artefact_id"]: row["num_bytes"] for row in made}
    judged: dict[str, dict[str, dict[MetricName, float]]] = {run_id: {} for run_id in runs}
    for row in rows("metrics", where={"run_id": runs}):
        if row["value"] is not None:
            name = row["protocol"], row["trajectory"], row["name"]
            judged[row["run_id"]].setdefault(row["variant"], {})[name] = row["value"]
    ended = [row for row in sequences if row["run_id"] in runs and row["state"] == "done"]
    results = {run_id: json_of(run, "result") for run_id, run in runs.items()}
    points = [
        Point(
            scene=row["scene_id"],
            configuration=row["configuration"] or fleet,
            seed=row["fit_seed"] or 0,
            run_id=row["run_id"],
            cost=_cost(results[row["run_id"]], sizes[scenes[row["run_id"]]]),
            metrics={
                name: value
                for variant in _at_end(runs[row["run_id"]])
                for name, value in judged[row["run_id"]].get(variant, {}).items()
            },
            by_variant=judged[row["run_id"]],
            suspicions=results[row["run_id"]].get("suspicions"),
        )
        for row in ended
    ]
    names = {row["sequence_id"] for row in ended}
    return points, [row for row in sequences if row["sequence_id"] not in names]


def _scenes(run: Row) -> list[str]:
    return [one for one in run["artefacts"] if ArtefactRef.of_id(one).kind == "gaussians"]


def _at_end(run: Row) -> tuple[str, ...]:
    """Variants of numbers that are of its last scene; without a round that is the first fit."""
    return (UNPAINTED, *FINAL) if len(_scenes(run)) == 1 else FINAL


def _cost(result: Mapping[str, Any], scene_bytes: int) -> dict[str, float]:
    # edited runs, and those of before 2026-11-28, tell the peak of all stages alone
    peaks = result.get("memory_bytes") or {"run": result["peak_memory_bytes"]}
    return {
        "seconds": _made(result["seconds"]),
        "cpu_seconds": _made(result["cpu_seconds"]),
        "peak_memory_bytes": max(peak for stage, peak in peaks.items() if not _judges(stage)),
        "num_gaussians": result["num_gaussians"],
        "scene_bytes": scene_bytes,
    }


def _made(by_stage: Mapping[str, float]) -> float:
    return sum(cost for stage, cost in by_stage.items() if not _judges(stage))


def _judges(stage: str) -> bool:
    return stage == "total" or stage.startswith(JUDGING)
