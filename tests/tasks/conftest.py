"""The toy scene through every stage, once for all tests of the stages and of what they left."""

import sys

import pytest
from toy_store import TOY_SCENE, small_parameters, write_toy_scene

from catalog.artefacts import ArtefactStore
from catalog.store import open_store
from tasks.evaluation.views import evaluate, load_scores
from tasks.ingest.ingest import record_scene
from tasks.reconstruction.fit import fit, refine
from tasks.reconstruction.paint import paint
from tasks.reconstruction.prepare import prepare
from tasks.reconstruction.publish import begin_run, complete_run
from tasks.reconstruction.report import REPORT_FILE, ReportInputs, write_report
from tasks.runs import open_run
from tasks.specs import FittedRef
from tasks.views.render import ViewedRun


@pytest.fixture(scope="package")
def store(tmp_path_factory):
    store = open_store(tmp_path_factory.mktemp("store"))
    record_scene(store, write_toy_scene(store.root))
    return store


@pytest.fixture(scope="package")
def parameters():
    return small_parameters()


@pytest.fixture(scope="package")
def ran():
    """Modules whose functions were called while a stage was built, by its artefact's digest."""
    produce, ran = ArtefactStore.produce, {}

    def watched(store, recipe, build, **options):
        called = ran.setdefault(recipe.digest, set())

        def watch(frame, event, _argument):
            if event == "call":
                called.add(frame.f_globals.get("__name__", ""))

        def watched_build(place):
            sys.setprofile(watch)
            try:
                return build(place)
            finally:
                sys.setprofile(None)

        return produce(store, recipe, watched_build, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ArtefactStore, "produce", watched)
        yield ran


@pytest.fixture(scope="package")
def stages(store, parameters, ran):  # noqa: ARG001 - it watches them being built
    """Every stage's result by its name."""
    run = parameters.run_spec(store.root)
    seen = prepare.fn(run, parameters.observation)
    first = fit.fn(run, "fit", seen.ref, parameters.fit)
    fitted = FittedRef(seen.ref, first.ref)
    novel, conditions = parameters.novel, parameters.conditions
    painted = paint.fn(run, "paint-1", fitted, novel, conditions, start_frame=0)
    refined = refine.fn(run, "refine-1", fitted, parameters.refine, guidance=painted.ref)
    final, config = FittedRef(seen.ref, refined.ref), parameters.evaluation_config
    return {
        "prepare": seen,
        "fit": first,
        "paint-1": painted,
        "refine-1": refined,
        "evaluate-unpainted": evaluate.fn(run, "evaluate-unpainted", fitted, config),
        "evaluate": evaluate.fn(run, "evaluate", final, config),
        "evaluate-view-time": evaluate.fn(run, "evaluate-view-time", final, config, view_time=True),
    }


@pytest.fixture(scope="package")
def final(stages):
    return FittedRef(stages["prepare"].ref, stages["refine-1"].ref)


@pytest.fixture(scope="package")
def run(store, parameters, stages, final):
    """A complete run with its report."""
    asked = parameters.run_spec(store.root)
    record = begin_run.fn(asked, "a" * 16, "b" * 32, "preview", parameters)
    scores = {
        "unpainted": load_scores(store, stages["evaluate-unpainted"].ref),
        "painted": load_scores(store, stages["evaluate"].ref),
    }
    result = {
        "run_id": record.run_id,
        "scene": TOY_SCENE,
        "preset": "preview",
        "painter": "warp",
        "split": "alternate",
        "rounds": 1,
        "seconds": {name: stage.seconds for name, stage in stages.items()},
        "peak_memory_bytes": 1,
        "num_gaussians": stages["refine-1"].summary["num_gaussians"],
        **scores["painted"],
        "unpainted": scores["unpainted"],
        "guidance": {"paint-1": stages["paint-1"].summary},
    }
    page = ReportInputs(
        result=result,
        source_digest=record.source_digest,
        unpainted=FittedRef(stages["prepare"].ref, stages["fit"].ref),
        final=final,
        stages=stages,
    )
    report = write_report.fn(asked, page, parameters.evaluation_config)
    result["report"] = store.name_of(store.artefacts.folder(report.ref) / REPORT_FILE)
    refs = tuple(stage.ref for stage in stages.values())
    complete_run.fn(store.root, record, result, scores, refs)
    return open_run(store, record.run_id)


@pytest.fixture(scope="package")
def viewed(store, run, parameters):
    """The run as stages that show it are given it."""
    return ViewedRun(
        run=parameters.run_spec(store.root),
        fitted=run.final,
        observation=parameters.observation,
        conditions=parameters.conditions,
    )
