"""Make a new run of a finished one: edited, styled, or changed in any other way that is kept.

Nothing is changed in place: the source run stays as it is, and the new run names it
(`derived_from`) and what was changed (`change`) in the catalog. It can be rendered, judged,
explained, deleted and changed again like any other; it stays whole where its source is deleted.

A change is one module-level function that builds, such as `put_style`, and one call of
`derive_run`, such as that of `style_run`. A build makes a new scene: what is loaded is shared.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from catalog.artefacts import Workplace
from catalog.digests import canonical_json, digest_text, plain
from catalog.records import RunRecord, run_id_of
from catalog.store import Store
from flows.parameters import view_parameters
from flows.recall import early_end_recorded, located, recalled_run
from lidarpainter_models.weather.mix import StyleMix
from tasks.editing.edit import put_style
from tasks.opened import open_scene
from tasks.progress import Progress
from tasks.reconstruction.publish import begin_run, complete_run
from tasks.runs import FinishedRun, open_run
from tasks.stages import project_source, run_stage
from tasks.stored import load_observations, load_scene

Build = Callable[[Workplace, Progress], Mapping[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Change:
    """What becomes of a run, in words."""

    kind: str
    """A word for tables, which is also the name of the stage: `edit`, `style`."""
    parameters: Any
    """All that decides about the result, with a canonical form: the edits, the style."""
    inputs: Mapping[str, str] = field(default_factory=dict)
    """Digests of what else is read, by the part it plays: another run's artefact, weights."""


def derive_run(
    store: Store,
    source: FinishedRun,
    change: Change,
    *,
    build: Build,
    build_observations: Build | None = None,
    check: Callable[[], None] | None = None,
) -> dict[str, Any]:
    """Change a finished run into a new one, or recall the one that this change made before.

    The id of the run is a digest of the source's final artefacts, the change and the code that the
    builds reach, so the same change of the same run is recalled: nothing is computed or written.

    Args:
        store: where both runs are.
        source: what is changed, `open_run` gives it.
        change: see there; the final artefacts of the source are inputs anyway.
        build: writes the changed scene (`tasks.stored.save_scene`) into `place.output` and returns
            `describe(scene)`, with more to say if there is: the summary of the artefact. A function
            of a module or a `partial` of one; hand it loaders, so that recalling loads nothing.
        build_observations: likewise writes what painters and fits may see of the changed scene
            (`save_observations`); None keeps the source's.
        check: refuses, by an error, what cannot be done, before anything is entered.

    Returns:
        What `--json` prints: as `reconstruct`'s without scores, with `derived_from`, `change` and
        `summary`, what `build` returned.
    """
    builds = {change.kind: build}
    if build_observations is not None:
        builds = {f"{change.kind}-observations": build_observations, **builds}
    inputs = {
        "source": source.final.gaussians.digest,
        "observations": source.final.observations.digest,
        **change.inputs,
    }
    told = {"kind": change.kind, "parameters": plain(change.parameters)}
    codes = [project_source().code(made).digest for made in builds.values()]
    code = codes[0] if len(codes) == 1 else digest_text(canonical_json(codes))
    run_id = run_id_of(digest_text(canonical_json(inputs)), told, code)
    if (known := recalled_run(store, run_id)) is not None:
        return known
    if check is not None:
        check()
    run = view_parameters(source).run_spec(store.address)
    with store.run_lock(run_id):
        record = begin_run.fn(
            run,
            run_id,
            code,
            source.preset,
            source.parameters,
            derived_from=source.run_id,
            change=told,
        )
        with early_end_recorded(store.address, record):
            return _derive(store, source, record, builds, inputs, told)


def _derive(
    store: Store,
    source: FinishedRun,
    record: RunRecord,
    builds: Mapping[str, Build],
    inputs: Mapping[str, str],
    told: Mapping[str, Any],
) -> dict[str, Any]:
    """Go through the stages, keyed on inputs and change, and enter what came of them."""
    started = time.perf_counter()
    kind = told["kind"]
    stages = {
        stage: run_stage(
            store,
            stage=stage,
            kind="gaussians" if stage == kind else "observations",
            inputs=inputs,
            config=told,
            build=build,
        )
        for stage, build in builds.items()
    }
    refs = [stage.ref for stage in stages.values()]
    if len(refs) == 1:
        refs.insert(0, source.final.observations)
    last = stages[kind]
    result = {
        "run_id": record.run_id,
        "scene": record.scene_id,
        "preset": record.preset,
        "painter": record.painter,
        "device": record.device,
        "derived_from": record.derived_from,
        "change": told,
        "seconds": {name: stage.seconds for name, stage in stages.items()}
        | {"total": time.perf_counter() - started},
        "cpu_seconds": {name: stage.cpu_seconds for name, stage in stages.items()},
        "computed_now": {name: stage.is_new for name, stage in stages.items()},
        "peak_memory_bytes": max(stage.peak_memory_bytes for stage in stages.values()),
        "num_gaussians": last.summary["num_gaussians"],
        "summary": last.summary,
        "artefacts": {name: stage.ref.artefact_id for name, stage in stages.items()},
        "report": None,
    }
    return located(complete_run.fn(store.address, record, result, {}, tuple(refs)), store)


STYLE = "style"
"""The kind of the change."""


def style_run(store: Store, run: str, mix: StyleMix, *, seed: int) -> dict[str, Any]:
    """Derive a run in a style, or recall the one that was; see `flows.derive`.

    The seed decides which windows are lit and where puddles stand.
    """
    source = open_run(store, run)
    recorded = open_scene(store, source.scene_id)
    told = {"prompt": mix.text, "visibility_m": mix.visibility_m, "seed": seed}
    return derive_run(
        store,
        source,
        Change(kind=STYLE, parameters=told, inputs={"scene": recorded.content_digest}),
        build=partial(
            put_style,
            scene=partial(load_scene, store, source.final.gaussians),
            observations=partial(load_observations, store, source.final.observations),
            recorded=partial(open_scene, store, source.scene_id),
            mix=mix,
            seed=seed,
        ),
    )
