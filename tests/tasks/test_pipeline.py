"""The stages of a reconstruction, one after the other, without a server."""

import json
import re
import shutil
import sys
from dataclasses import replace

import cv2
import pytest
import torch
from toy_store import TOY_SCENE, small_parameters, write_toy_scene

from catalog.artefacts import ArtefactStore
from catalog.errors import DamagedArtefactError
from catalog.schemas import TABLES
from catalog.store import STORE_ENVIRONMENT, open_store
from flows.cli.main import main
from lidarpainter_models.conditioning.settings import SequenceConfig
from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.evaluation.score_tables import flicker_by_image, metric_values
from lidarpainter_models.evaluation.settings import ScoringConfig
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from lidarpainter_models.metrics import lpips
from lidarpainter_models.metrics.backbones import SQUEEZENET
from tasks.evaluation.flicker import evaluate_flicker
from tasks.evaluation.views import evaluate, load_scores
from tasks.ingest.ingest import record_scene
from tasks.opened import open_scene
from tasks.painter.judge import judge_painters
from tasks.painter.judged_fits import JudgedFit
from tasks.reconstruction.fit import fit
from tasks.reconstruction.paint import paint
from tasks.reconstruction.painted_views import load_guidance
from tasks.reconstruction.prepare import prepare
from tasks.reconstruction.publish import begin_run, complete_run, end_run
from tasks.reconstruction.report import REPORT_FILE, ReportInputs, write_report
from tasks.runs import open_run
from tasks.specs import FittedRef
from tasks.stored import load_history, load_scene
from tasks.views.render import RenderRequest, render
from tasks.views.stylize import StylizeRequest, stylize


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    store = open_store(tmp_path_factory.mktemp("store"))
    record_scene(store, write_toy_scene(store.root))
    return store


@pytest.fixture(scope="module")
def parameters():
    return small_parameters()


@pytest.fixture(scope="module")
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


@pytest.fixture(scope="module")
def stages(store, parameters, ran):  # noqa: ARG001 - it watches them being built
    """Every stage's result by its name."""
    run = parameters.run_spec(store.root)
    seen = prepare.fn(run, parameters.observation)
    first = fit.fn(run, "fit", seen.ref, parameters.fit)
    fitted = FittedRef(seen.ref, first.ref)
    novel, conditions = parameters.novel, parameters.conditions
    painted = paint.fn(run, "paint-1", fitted, novel, conditions, start_frame=0)
    refined = fit.fn(
        run, "refine-1", seen.ref, parameters.refine, start=first.ref, guidance=painted.ref
    )
    final, config = FittedRef(seen.ref, refined.ref), parameters.judge_config
    return {
        "prepare": seen,
        "fit": first,
        "paint-1": painted,
        "refine-1": refined,
        "evaluate-unpainted": evaluate.fn(run, "evaluate-unpainted", fitted, config),
        "evaluate": evaluate.fn(run, "evaluate", final, config),
        "evaluate-view-time": evaluate.fn(run, "evaluate-view-time", final, config, view_time=True),
    }


@pytest.fixture(scope="module")
def final(stages):
    return FittedRef(stages["prepare"].ref, stages["refine-1"].ref)


@pytest.fixture(scope="module")
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
    report = write_report.fn(asked, page, parameters.judge_config)
    result["report"] = store.name_of(store.artefacts.folder(report.ref) / REPORT_FILE)
    refs = tuple(stage.ref for stage in stages.values())
    complete_run.fn(store.root, record, result, scores, refs)
    return open_run(store, record.run_id)


def test_every_stage_leaves_an_artefact_with_a_manifest(store, stages):
    for stage in stages.values():
        assert store.artefacts.verified(stage.ref).kind == stage.ref.kind
    assert len(store.tables.rows("artefacts")) == len(stages)


def test_the_code_of_a_stage_holds_every_module_that_ran(store, stages, ran):
    for name, stage in stages.items():
        project = {
            one for one in ran[stage.ref.digest] if one.startswith(("tasks", "lidarpainter"))
        }
        harness = {"tasks.stages", "tasks.measuring"}
        assert len(project) > 10, name
        assert project - harness <= store.artefacts.manifest(stage.ref).code.keys(), name


def test_an_artefact_is_explained_back_to_its_scene(run, store, capsys, monkeypatch):
    monkeypatch.setenv(STORE_ENVIRONMENT, str(store.root))
    assert main(["catalog", "explain", run.run_id]) == 0
    page = capsys.readouterr().out
    assert f"scene: {TOY_SCENE}" in page
    assert "STALE" not in page
    assert main(["catalog", "explain", run.final.gaussians.artefact_id, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["inputs"]["guidance"]["inputs"]["scene"]["name"] == TOY_SCENE
    assert not found["is_stale"]


def test_a_stage_asked_again_is_not_computed_again(store, parameters, stages):
    run = parameters.run_spec(store.root)
    again = fit.fn(run, "fit", stages["prepare"].ref, parameters.fit)
    assert not again.is_new
    assert again.ref == stages["fit"].ref


def test_a_fit_keeps_its_course_and_no_scratch(store, stages):
    history = load_history(store, stages["fit"].ref)
    assert [entry["step"] for entry in history] == [5, 10, 12]
    assert list((store.root / "work").iterdir()) == []
    scene = load_scene(store, stages["fit"].ref)
    assert scene.num_gaussians == stages["fit"].summary["num_gaussians"]


def test_painted_views_come_back_as_guidance(store, stages):
    views = load_guidance(store, stages["paint-1"].ref)
    assert len(views) == stages["paint-1"].summary["num_views"] > 0
    for view in views:
        assert view.rgb.shape == (view.camera.height_px, view.camera.width_px, 3)
        assert 0 <= float(view.weight.min()) <= float(view.weight.max()) <= 1
    images = store.artefacts.folder(stages["paint-1"].ref) / "images" / "left-2m"
    assert {path.stem for path in images.iterdir()} >= {"render", "painted", "confidence"}


def test_scores_say_why_a_number_is_missing(store, stages):
    scores = load_scores(store, stages["evaluate"].ref)
    assert scores["recorded"]["psnr"] > 10
    assert scores["recorded"]["num_views"] == 2
    left = scores["novel"]["left-2m"]
    assert left["psnr"] is None
    assert "nobody took images" in left["psnr_reason"]
    assert 0 <= left["depth_within_5_percent"] <= 1


def test_lpips_stands_in_the_scores_where_both_files_are_given(
    store, parameters, final, tmp_path, monkeypatch
):
    monkeypatch.setattr(lpips, "is_published", lambda _path, _backbone: True)  # random weights
    torch.manual_seed(0)
    torch.save(SQUEEZENET.build().state_dict(), tmp_path / "backbone.pth")
    heads = {
        lpips.HEAD_KEY.format(index): torch.rand(1, count, 1, 1)
        for index, count in enumerate(SQUEEZENET.channels)
    }
    torch.save(heads, tmp_path / "heads.pth")
    files = lpips.LpipsFiles(backbone=tmp_path / "backbone.pth", heads=tmp_path / "heads.pth")
    without, asked = parameters.judge_config, parameters.run_spec(store.root)
    for config, has_figure in ((without, False), (replace(without, lpips=files), True)):
        judged = evaluate.fn(asked, "evaluate", final, config)
        recorded = load_scores(store, judged.ref)["recorded"]
        assert (recorded["lpips"] is not None) is has_figure
        assert ("lpips_reason" in recorded) is not has_figure
    assert recorded["lpips"] > 0
    assert recorded["recorded_poses"]["lpips"] > 0


def test_painting_at_view_time_is_judged_apart(stages):
    assert stages["evaluate-view-time"].ref != stages["evaluate"].ref


def test_painters_are_judged_by_the_held_out_views_of_a_first_fit(store, run, parameters):
    fit_of_run = JudgedFit(
        store_path=store.root,
        run_id=run.run_id,
        split=parameters.split_spec,
        fitted=run.unpainted,
        settings=parameters.judge_config,
    )
    labels = {"none": "none", "warp": "warp"}
    found = judge_painters.fn(labels, (), fits=[fit_of_run])
    (name,) = found["pairs"]
    assert name == f"{TOY_SCENE} recorded"
    recorded = run.result["unpainted"]["recorded"]
    assert found["pairs"][name]["num_judged"] == recorded["num_views"]
    unpainted = found["painters"]["none"]["sources"][name]["painted"]["psnr"]
    assert unpainted == pytest.approx(recorded["psnr"], abs=0.01)
    with_warps = found["painters"]["warp"]["total"]
    assert with_warps["painted"]["psnr"] == with_warps["warp_mean"]["psnr"] != unpainted
    with pytest.raises(ConfigError, match=f"one run of each scene, got two of {TOY_SCENE}"):
        judge_painters.fn(labels, (), fits=[fit_of_run, fit_of_run])


def test_neighbouring_frames_are_compared_along_every_shift(store, parameters, final):
    shifts = ScoringConfig(shifts=(Shift(lateral_m=1.0),))
    config = replace(parameters.judge_config, scoring=shifts)
    mixed = (SequenceConfig(previous="mixed"),)
    asked = parameters.run_spec(store.root)
    judged = evaluate_flicker.fn(asked, "flicker", final, config, mixed)
    scores = load_scores(store, judged.ref)
    found = scores["flicker"]["left-1m"]
    assert set(found) == {"render", "painted", "painted, previous mixed"}
    assert 0 < found["painted, previous mixed"]["flicker"] < found["painted"]["flicker"]
    assert found["render"]["psnr"] is None  # nobody knows the truth there
    assert 0 < found["render"]["valid_share"] < 1
    by_name = {
        image: {name: value for _, _, name, value, _ in metric_values(values)}
        for image, values in flicker_by_image(scores["flicker"]).items()
    }
    assert by_name["painted"]["flicker"] == found["painted"]["flicker"]


def test_a_report_says_what_was_run_when_and_on_what(store, run, parameters):
    page = (store.root / run.result["report"]).read_text("utf-8")
    scene = open_scene(store, TOY_SCENE)
    assert f"Sequence {scene.sequence} of the dataset {scene.dataset}: " in page
    known, settings = (
        dict(re.findall(r'<th scope="row">(.*?)</th><td>(.*?)</td>', part))
        for part in page.split("<h2>Settings</h2>")
    )
    assert settings["fit.steps"] == str(parameters.fit.steps)
    assert known["scene content"] == scene.content_digest
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d UTC", known["date"])
    assert known["processor"]
    assert known["cores"][0].isdigit()
    assert known["memory"].endswith(" GB")
    assert known["device"] == "cpu"
    assert f"torch {torch.__version__.split('+')[0]}" in known["versions"]


def test_a_report_stands_alone(store, run):
    page = (store.root / run.result["report"]).read_text("utf-8")
    assert page.startswith("<!doctype html>")
    assert run.run_id in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert 'src="data:image/jpeg;base64,' in page


def test_a_run_is_found_with_its_numbers(store, run):
    assert run.final.gaussians.kind == "gaussians"
    assert run.unpainted.gaussians != run.final.gaussians
    row = store.run("latest")
    assert row["run_id"] == run.run_id
    metrics = store.tables.rows("metrics")
    assert {metric["variant"] for metric in metrics} == {"unpainted", "painted"}
    assert all(
        (metric["value"] is None) == bool(metric["reason"])
        for metric in metrics
        if metric["name"] == "psnr"
    )


def test_a_failed_run_says_why(store, parameters):
    asked = parameters.run_spec(store.root)
    record = begin_run.fn(asked, "f" * 16, "b" * 32, "balanced", parameters)
    assert store.tables.row("runs", record.run_id)["status"] == "running"
    end_run.fn(store.root, record, "failed", "SceneError: no image")
    assert store.tables.row("runs", record.run_id)["error"] == "SceneError: no image"


@pytest.mark.parametrize("is_painted", [False, True])
def test_a_run_is_rendered_where_nobody_drove(store, run, parameters, tmp_path, is_painted):
    request = RenderRequest(
        trajectory=parse_trajectory("lane-change:2+up:0.5"),
        frames=slice(1, 3),
        is_painted=is_painted,
        observation=parameters.observation,
        conditions=parameters.conditions,
    )
    made = render.fn(parameters.run_spec(store.root), run.final, request, tmp_path)
    assert made["num_images"] == 2
    described = json.loads((tmp_path / "trajectory.json").read_text())
    assert [row["file"] for row in described["images"]] == ["0001.png", "0002.png"]
    first, last = (row["world_from_camera"] for row in described["images"])
    assert last[7] - first[7] == pytest.approx(2.0, abs=0.2)  # y is to the left


@pytest.mark.parametrize("images", ["rendered", "recorded"])
def test_a_run_is_shown_in_fog_beside_the_clear_images(store, run, parameters, tmp_path, images):
    view = RenderRequest(
        trajectory=parse_trajectory("recorded"),
        frames=slice(1, 3),
        observation=parameters.observation,
        conditions=parameters.conditions,
    )
    request = StylizeRequest(prompt="foggy", view=view, images=images)
    made = stylize.fn(parameters.run_spec(store.root), run.final, request, tmp_path / "a")
    assert made["num_images"] == 2
    assert 0.5 < made["edge_f1"] <= 1
    described = json.loads((tmp_path / "a" / "trajectory.json").read_text())
    assert (described["prompt"], len(described["images"])) == ("foggy", 2)
    foggy, clear = (
        cv2.imread(str(tmp_path / "a" / name)) for name in ("0001.png", "clear/0001.png")
    )
    assert float(foggy.std()) < float(clear.std())
    stylize.fn(parameters.run_spec(store.root), run.final, request, tmp_path / "b")
    again = (tmp_path / "b" / "0001.png").read_bytes()
    assert again == (tmp_path / "a" / "0001.png").read_bytes()


def test_a_painter_is_asked_for_the_prompt(store, run, parameters, tmp_path):
    request = RenderRequest(
        trajectory=parse_trajectory("recorded"),
        frames=slice(1, 2),
        is_painted=True,
        prompt="foggy",
        observation=parameters.observation,
        conditions=parameters.conditions,
    )
    with pytest.raises(ConfigError, match="knows no prompt 'foggy', only: clear"):
        render.fn(parameters.run_spec(store.root, painter="nano"), run.final, request, tmp_path)
    with pytest.raises(ConfigError, match="prompt 'foggy' needs a painter"):
        replace(request, is_painted=False)


def test_a_path_is_painted_with_the_previous_image_mixed_in(store, run, parameters, tmp_path):
    plain = RenderRequest(
        trajectory=parse_trajectory("lateral:1"),
        frames=slice(0, 3),
        is_painted=True,
        observation=parameters.observation,
        conditions=parameters.conditions,
    )
    mixed = replace(plain, sequence=SequenceConfig(previous="mixed"))
    for name, request in (("plain", plain), ("mixed", mixed)):
        render.fn(parameters.run_spec(store.root), run.final, request, tmp_path / name)
    same = [
        (tmp_path / "plain" / name).read_bytes() == (tmp_path / "mixed" / name).read_bytes()
        for name in ("0000.png", "0001.png", "0002.png")
    ]
    assert same == [True, False, False]
    with pytest.raises(ConfigError, match="--previous needs a painter"):
        replace(mixed, is_painted=False)


def test_recorded_images_exist_only_where_somebody_stood(parameters):
    view = RenderRequest(
        trajectory=parse_trajectory("lateral:2"),
        observation=parameters.observation,
        conditions=parameters.conditions,
    )
    with pytest.raises(ConfigError, match="on the recorded trajectory"):
        StylizeRequest(prompt="foggy", view=view, images="recorded")
    with pytest.raises(ConfigError, match="no images 'drawn'"):
        StylizeRequest(prompt="foggy", view=view, images="drawn")
    with pytest.raises(ConfigError, match="no style 'snow'"):
        StylizeRequest(prompt="snow", view=view)


def test_an_unknown_camera_is_named_before_anything_is_drawn(store, run, parameters, tmp_path):
    request = RenderRequest(
        trajectory=parse_trajectory("recorded"),
        camera="back",
        observation=parameters.observation,
        conditions=parameters.conditions,
    )
    with pytest.raises(SceneError, match="saw no camera 'back', it saw front"):
        render.fn(parameters.run_spec(store.root), run.final, request, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_input_is_found_and_not_used(store, parameters, stages):
    file = store.artefacts.folder(stages["prepare"].ref) / "observations.safetensors"
    content = file.read_bytes()
    file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    try:
        config = parameters.fit.__class__(steps=1)
        with pytest.raises(DamagedArtefactError, match="is not what was written"):
            fit.fn(parameters.run_spec(store.root), "fit", stages["prepare"].ref, config)
    finally:
        file.write_bytes(content)


def looked_at(store, parameters):
    """A run of a store, after everything that reading it is there for was done with it."""
    run = open_run(store, "latest")
    assert load_scene(store, run.final.gaussians).num_gaussians == run.result["num_gaussians"]
    assert store.path_of(run.result["report"]).is_file()
    asked = parameters.run_spec(store.root)
    seen = prepare.fn(asked, parameters.observation)
    first = fit.fn(asked, "fit", seen.ref, parameters.fit)
    judged = evaluate.fn(asked, "evaluate", run.final, parameters.judge_config)
    assert [stage.is_new for stage in (seen, first, judged)] == [False] * 3
    return run


def content_of(root):
    return {path: path.stat().st_mtime_ns for path in root.rglob("*")}


def test_a_store_that_was_moved_is_read_and_nothing_is_written(store, run, parameters, tmp_path):
    moved = open_store(tmp_path / "moved")
    shutil.copytree(store.root, moved.root)
    for file in moved.root.glob("artefacts/*/*/manifest.json"):
        assert str(store.root) not in file.read_text()
    for table in TABLES:
        assert str(store.root) not in str(moved.tables.rows(table))
    before = content_of(moved.root)
    assert looked_at(moved, parameters).run_id == run.run_id
    assert content_of(moved.root) == before
