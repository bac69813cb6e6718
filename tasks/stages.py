"""What all stages share: their identity, their measurement, their retries.

A stage's artefact is keyed on its inputs, its configuration, the source of the library packages it
runs (`SOURCES`) and of the task module that writes it. Prefect's own cache is off: its key would
see the thin task only, and what is done is written in the store.
"""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from prefect import Task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun

import lidarpainter_models
from catalog.artefacts import ArtefactRef, Recipe, Workplace
from catalog.digests import digest_file, digest_source, digest_text
from catalog.errors import CatalogError, ConflictError
from catalog.records import artefact_row
from catalog.store import Store
from lidarpainter_models.errors import LidarPainterError
from tasks.measuring import measured
from tasks.progress import listener

LIBRARY = Path(lidarpainter_models.__file__).parent
BASE = ("errors.py", "geometry", "kernels", "scenes", "lidar", "observations")
SOURCES: dict[str, tuple[str, ...]] = {
    "observations": (*BASE, "gaussians"),
    "gaussians": (*BASE, "gaussians"),
    "guidance": (*BASE, "gaussians", "painter", "conditioning"),
    "evaluation": (*BASE, "gaussians", "painter", "conditioning", "metrics", "evaluation"),
    "strips": (*BASE, "gaussians", "painter", "conditioning", "metrics", "evaluation"),
    "report": (*BASE, "gaussians", "painter", "conditioning", "metrics", "evaluation", "export"),
    "pairs": (*BASE, "gaussians", "painter", "conditioning", "training_data"),
    "painter": (*BASE, "painter", "metrics"),
}
"""Library packages by kind of artefact."""
TASKS = Path(__file__).parent
FILE_FORMATS = ("reconstruction/painted_views.py", "stored.py", "tensors.py")
"""Task modules that decide what lies in an artefact's files."""

RETRIES = 2
RETRY_DELAY_S = 3


@dataclass(frozen=True, kw_only=True)
class StageResult:
    """What a stage hands on: a reference, never tensors."""

    ref: ArtefactRef
    seconds: float
    """Wall time of the computation, whenever it took place."""
    cpu_seconds: float
    """CPU time of the same, over all threads."""
    peak_memory_bytes: int
    is_new: bool
    """Whether it was computed in this run."""
    summary: dict[str, Any]


@cache
def library_digest(kind: str | None = None) -> str:
    """Digest of the library source behind a kind of artefact, or of all of it.

    Taken once per process: the modules in memory are those that were read at its start.
    """
    if kind is None:
        return digest_source(LIBRARY, [path.name for path in _all_parts()])
    return digest_source(LIBRARY, SOURCES[kind])


def stage_digest(kind: str, build: Callable[..., Any]) -> str:
    """Digest of all source behind an artefact: the library's, and how a task writes it."""
    own = digest_file(Path(inspect.getfile(build)))
    return digest_text(library_digest(kind) + own + digest_source(TASKS, FILE_FORMATS))


def run_stage(
    store: Store,
    *,
    stage: str,
    kind: str,
    inputs: Mapping[str, str],
    config: Any,  # noqa: ANN401 - any configuration with a canonical form
    build: Callable[[Workplace], Mapping[str, Any]],
) -> StageResult:
    """Produce the artefact of a stage, or take the one that is there, and catalogue it."""
    recipe = Recipe(
        kind=kind,
        inputs=inputs,
        config=config,
        source_digest=stage_digest(kind, build),
        software_version=lidarpainter_models.__version__,
    )

    def measured_build(place: Workplace) -> dict[str, Any]:
        with measured() as cost:
            summary = build(place)
        return {
            **summary,
            "cpu_seconds": round(cost.cpu_seconds, 3),
            "peak_memory_bytes": cost.peak_memory_bytes,
        }

    listener().started(stage)
    ref, is_new = store.artefacts.produce(
        recipe, measured_build, on_wait=lambda process_id: listener().waiting(stage, process_id)
    )
    manifest = store.artefacts.manifest(ref)
    if is_new:
        store.tables.merge("artefacts", [artefact_row(ref, manifest)])
    listener().finished(stage, manifest.seconds, is_new=is_new)
    return StageResult(
        ref=ref,
        seconds=manifest.seconds,
        cpu_seconds=manifest.summary["cpu_seconds"],
        peak_memory_bytes=manifest.summary["peak_memory_bytes"],
        is_new=is_new,
        summary=manifest.summary,
    )


def is_worth_retrying(_task: Task[..., Any], _run: TaskRun, state: State[Any]) -> bool:
    """Retry what may pass by itself; bad input and a full disk do not."""
    error = state.result(raise_on_failure=False)
    if isinstance(error, ConflictError):
        return True
    if isinstance(error, (LidarPainterError, CatalogError)):
        return False
    return isinstance(error, (ConnectionError, TimeoutError, BlockingIOError, InterruptedError))


STAGE_OPTIONS: dict[str, Any] = {
    "cache_policy": NO_CACHE,
    "retries": RETRIES,
    "retry_delay_seconds": RETRY_DELAY_S,
    "retry_condition_fn": is_worth_retrying,
    "persist_result": False,
}
"""Options of every stage's task."""


def _all_parts() -> list[Path]:
    return [
        path
        for path in LIBRARY.iterdir()
        if path.suffix == ".py" or (path.is_dir() and any(path.rglob("*.py")))
    ]
