"""A run opens its scene once, loads its painter once and decodes an image at most once a stage."""

from collections import Counter

import pytest
from toy_store import small_parameters, write_toy_scene

from catalog.store import open_store
from lidarpainter_models.painter.baselines import OverlayPainter
from lidarpainter_models.scenes.driving_scene import DrivingScene
from tasks import opened as opening
from tasks.evaluation.views import evaluate, load_scores
from tasks.ingest.ingest import record_scene
from tasks.reconstruction.fit import fit, refine
from tasks.reconstruction.paint import paint
from tasks.reconstruction.prepare import prepare
from tasks.reconstruction.publish import begin_run
from tasks.reconstruction.report import ReportInputs, write_report
from tasks.specs import FittedRef


class Counted:
    """Calls of what is dear, by stage."""

    def __init__(self, monkeypatch):
        self.stage, self.decoded = "", Counter()
        self.opened, self.painters = [], []
        self._watch(monkeypatch, DrivingScene, "read_image", self._decoding)
        self._watch(monkeypatch, DrivingScene, "__init__", lambda _scene, _stored: self._opening())
        self._watch(monkeypatch, OverlayPainter, "__init__", self._loading)

    def _watch(self, monkeypatch, owner, name, told):
        original = getattr(owner, name)

        def watched(*arguments):
            told(*arguments)
            return original(*arguments)

        monkeypatch.setattr(owner, name, watched)

    def _decoding(self, _scene, view):
        self.decoded[self.stage, view.key] += 1

    def _opening(self):
        self.opened.append(self.stage)

    def _loading(self, painter):
        self.painters.append((self.stage, painter.name))


@pytest.fixture
def counted(tmp_path, monkeypatch):
    """What a whole run did."""
    store = open_store(tmp_path)
    record_scene(store, write_toy_scene(store.root))
    opening._scene.cache_clear()
    counted = Counted(monkeypatch)
    parameters = small_parameters(painter="overlay")
    run, config = parameters.run_spec(store.root), parameters.evaluation_config

    def stage(name, task, *arguments, **options):
        counted.stage = name
        return task.fn(run, *arguments, **options)

    record = stage("begin", begin_run, "a" * 16, "b" * 32, "preview", parameters)
    seen = stage("prepare", prepare, parameters.observation).ref
    made = {"fit": stage("fit", fit, "fit", seen, parameters.fit)}
    first = FittedRef(seen, made["fit"].ref)
    novel, conditions = parameters.novel, parameters.conditions
    made["paint-1"] = stage("paint", paint, "paint-1", first, novel, conditions, start_frame=0)
    guidance = made["paint-1"].ref
    made["refine-1"] = stage(
        "refine", refine, "refine-1", first, parameters.refine, guidance=guidance
    )
    final = FittedRef(seen, made["refine-1"].ref)
    before = stage("before", evaluate, "evaluate-unpainted", first, config)
    after = stage("after", evaluate, "evaluate", final, config, view_time=True)
    result = {
        "run_id": record.run_id,
        "scene": record.scene_id,
        "preset": "preview",
        "painter": "overlay",
        "split": "alternate",
        "rounds": 1,
        "num_gaussians": 1,
        **load_scores(store, after.ref),
        "unpainted": load_scores(store, before.ref),
        "guidance": {"paint-1": made["paint-1"].summary},
    }
    page = ReportInputs(
        result=result, source_digest="b" * 32, unpainted=first, final=final, stages=made
    )
    stage("report", write_report, page, config)
    return counted


@pytest.mark.slow
def test_a_run_opens_its_scene_and_its_painter_once_and_decodes_once_a_stage(counted):
    assert counted.opened == ["begin"]
    assert [name for _, name in counted.painters] == ["overlay"]
    assert set(counted.decoded.values()) == {1}
    decoding = {stage for stage, _ in counted.decoded}
    assert decoding == {"prepare", "before", "after", "report"}
