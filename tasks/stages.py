"""What all stages share: their identity, their measurement, their retries.

A stage's artefact is keyed on its inputs, its configuration and the code that its build function
runs, found from the source (see `catalog.code_closure`). Prefect's own cache is off: its key would
see the thin task only, and what is done is written in the store.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ParamSpec, TypeVar

from prefect import Task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun
from prefect.context import FlowRunContext

import lidarpainter_models
from catalog.artefacts import ArtefactRef, Recipe, Workplace
from catalog.code_closure import Code, SourceTree
from catalog.digests import canonical_json, digest_text, plain
from catalog.errors import CatalogError, ConflictError
from catalog.records import artefact_row
from catalog.store import Store
from lidarpainter_models.devices import KernelChoice
from lidarpainter_models.errors import LidarPainterError
from lidarpainter_models.kernels.backends import kernels_chosen
from tasks.measuring import measured
from tasks.progress import Progress, listener, progress_of

PACKAGES = ("flows", "tasks", "lidarpainter_models")
"""What can decide about a result; the catalog carries bytes and is not followed."""


@cache
def project_source() -> SourceTree:
    """The source as it was when this process first looked."""
    return SourceTree.of_packages(*PACKAGES)


@cache
def code_behind(start: str) -> Code:
    """The code that is reached from a function, named `module:function`."""
    return project_source().code_from((start,))


SHOWN_DIGITS = 8
"""Digits of a digest, where people read it."""
_LOG = logging.getLogger("lidarpainter")
RETRIES = 2
RETRY_DELAY_S = 3

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True)
class StageResult:
    """What a stage hands on: a reference, never tensors."""

    ref: ArtefactRef
    seconds: float
    """Wall time of the computation, whenever it took place."""
    cpu_seconds: float
    """CPU time of the same over all threads, without compiling kernels."""
    peak_memory_bytes: int
    is_new: bool
    """Whether it was computed in this run."""
    summary: dict[str, Any]


def run_stage(
    store: Store,
    *,
    stage: str,
    kind: str,
    inputs: Mapping[str, str],
    config: Any,  # noqa: ANN401 - any configuration with a canonical form
    build: Callable[[Workplace, Progress], Mapping[str, Any]],
    kernels: KernelChoice = "auto",
) -> StageResult:
    """Produce the artefact of a stage, or take the one that is there, and catalogue it.

    `inputs` are digests by the part they play. `build`, a function of a module or a `partial` of
    one, writes the files. What other `kernels` make has a key of its own.

    Raises:
        IdentityError: the code that `build` runs cannot be found from the source.
    """
    recipe = Recipe(
        kind=kind,
        inputs=inputs,
        config=config if kernels == "auto" else {"kernels": kernels, "stage": config},
        code=project_source().code(build),
        software_version=lidarpainter_models.__version__,
    )

    def measured_build(place: Workplace) -> dict[str, Any]:
        with measured() as cost, kernels_chosen(kernels):
            summary = build(place, progress_of(stage))
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
    # who made it may have been killed before its row was written
    if is_new or store.tables.find("artefacts", ref.artefact_id) is None:
        store.tables.merge("artefacts", [artefact_row(ref, manifest)])
    listener().finished(stage, manifest.seconds, is_new=is_new)
    _log(stage, recipe, store.place_of(ref.entry), is_new=is_new)
    return StageResult(
        ref=ref,
        seconds=manifest.seconds,
        cpu_seconds=manifest.summary["cpu_seconds"],
        peak_memory_bytes=manifest.summary["peak_memory_bytes"],
        is_new=is_new,
        summary=manifest.summary,
    )


def _log(stage: str, recipe: Recipe, place: str, *, is_new: bool) -> None:
    """Say what a stage is keyed on, whether it was there, and where it lies."""
    _LOG.info(
        "%s: %s; from %s; settings %s; code %s; lies in %s",
        stage,
        "computed now" if is_new else "was there",
        ", ".join(f"{name} {digest[:SHOWN_DIGITS]}" for name, digest in recipe.inputs.items()),
        digest_text(canonical_json(plain(recipe.config)))[:SHOWN_DIGITS],
        recipe.code.digest[:SHOWN_DIGITS],
        place,
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


class StageTask(Task[Parameters, Result]):
    """A task that outside a flow is the plain function: nobody is asked and nothing is recorded."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401 - as Prefect has it
        """Run the stage, as a task run where there is a flow run."""
        if FlowRunContext.get() is None:
            return self.fn(*args, **kwargs)
        return super().__call__(*args, **kwargs)


def stage_task(function: Callable[Parameters, Result]) -> StageTask[Parameters, Result]:
    """Make a stage a task, with the options that all stages have."""
    return StageTask(function, **STAGE_OPTIONS)
