"""The stages of a reconstruction, one after the other, without a server."""

import base64
import csv
import json
import re
import shutil
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch
from toy_store import TOY_SCENE

from catalog.errors import DamagedArtefactError
from catalog.schemas import TABLES
from catalog.store import STORE_ENVIRONMENT, open_store
from flows.cli.main import main
from lidarpainter_models.conditioning.settings import SequenceConfig
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.score_tables import flicker_by_image, metric_values
from lidarpainter_models.evaluation.settings import ScoringConfig
from lidarpainter_models.export.pictures import PANEL_WIDTH_PX
from lidarpainter_models.gaussians.fitting.plan import in_thousands
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.metrics import lpips
from lidarpainter_models.metrics.backbones import SQUEEZENET
from lidarpainter_models.storage.tensor_files import read_tensors
from tasks.evaluation.views import evaluate, evaluate_flicker, load_scores
from tasks.opened import open_scene
from tasks.painter.evaluate import score_painters
from tasks.painter.held_out_fits import HeldOutFit
from tasks.reconstruction.fit import fit, refine
from tasks.reconstruction.paint import load_guidance
from tasks.reconstruction.prepare import prepare
from tasks.reconstruction.publish import begin_run, end_run
from tasks.runs import open_run
from tasks.specs import FittedRef
from tasks.stored import load_history, load_scene


def test_every_stage_leaves_an_artefact_with_a_manifest(store, stages):
    for stage in stages.values():
        assert store.artefacts.verified(stage.ref).kind == stage.ref.kind
    made = [row["artefact_id"] for row in store.tables.rows("artefacts")]
    assert len(made) == len(set(made))
    assert {stage.ref.artefact_id for stage in stages.values()} <= set(made)


def test_the_code_of_a_stage_holds_every_module_that_ran(store, stages, ran):
    for name, stage in stages.items():
        project = {
            one for one in ran[stage.ref.digest] if one.startswith(("tasks", "lidarpainter"))
        }
        harness = {"tasks.stages", "tasks.measuring", "lidarpainter_models.kernels.compile_clock"}
        assert len(project) > 10, name
        assert project - harness <= store.artefacts.manifest(stage.ref).code.keys(), name


def test_an_artefact_is_explained_back_to_its_scene(run, store, capsys, monkeypatch):
    monkeypatch.setenv(STORE_ENVIRONMENT, str(store.root))
    assert main(["catalog", "explain", run.run_id, "--verbose"]) == 0
    page = capsys.readouterr().out
    assert f"scene: {TOY_SCENE}" in page
    assert "STALE" not in page
    assert main(["catalog", "explain", run.final.gaussians.artefact_id, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["inputs"]["guidance"]["inputs"]["scene"]["name"] == TOY_SCENE
    assert not found["is_stale"]


def test_a_run_of_another_split_is_not_judged_as_neurad_studio_does(parameters, store, final):
    run = parameters.run_spec(store.root)
    with pytest.raises(ConfigError, match="with --split linspace, this one was with --split alter"):
        evaluate.fn(run, "neurad", final, parameters.evaluation_config, protocol="neurad")


def test_a_fit_keeps_its_course_and_no_scratch(store, stages):
    history = load_history(store, stages["fit"].ref)
    assert [entry["step"] for entry in history] == [5, 10, 12]
    with (store.artefacts.folder(stages["fit"].ref) / "history.csv").open() as table:
        rows = [
            {name: float(value) for name, value in row.items()} for row in csv.DictReader(table)
        ]
    assert rows == history
    plan = store.artefacts.manifest(stages["fit"].ref).summary["plan"]
    assert (plan["steps"], plan["most_gaussians"], plan["first_gaussians"]) == (12, 1000, 800)
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


def negatives(path):
    """Painted views in the colours that nobody painted, sure of every pixel."""
    arrays, metadata = read_tensors(path)
    for name, array in arrays.items():
        if name.endswith("rgb_u8"):
            arrays[name] = 255 - array
        elif name.endswith("weight_u8"):
            arrays[name] = torch.full_like(array, 255)
    return arrays, metadata


def test_a_round_that_makes_views_worse_is_to_be_taken_back(store, parameters, stages, monkeypatch):
    run, painted = parameters.run_spec(store.root), stages["paint-1"].ref
    first = FittedRef(stages["prepare"].ref, stages["fit"].ref)
    monkeypatch.setattr("tasks.reconstruction.paint.read_tensors", negatives)
    guidance = replace(parameters.refine.guidance, probability=1.0, weight=20.0)
    config = replace(parameters.refine, steps=60, guidance=guidance)
    spoilt = refine.fn(run, "refine-1", first, config, guidance=painted)
    gain = spoilt.summary["gain"]
    assert gain["is_taken_back"]
    assert gain["after_db"] < gain["before_db"] - 1
    assert stages["refine-1"].summary["gain"].keys() == gain.keys()


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
    without, asked = parameters.evaluation_config, parameters.run_spec(store.root)
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
    fit_of_run = HeldOutFit(
        store_path=store.root,
        run_id=run.run_id,
        split=parameters.split_spec,
        fitted=run.unpainted,
        settings=parameters.evaluation_config,
    )
    labels = {"none": "none", "warp": "warp"}
    found = score_painters.fn(labels, (), fits=[fit_of_run])
    (name,) = found["pairs"]
    assert name == f"{TOY_SCENE} recorded"
    recorded = run.result["unpainted"]["recorded"]
    assert found["pairs"][name]["num_judged"] == recorded["num_views"]
    unpainted = found["painters"]["none"]["sources"][name]["painted"]["psnr"]
    assert unpainted == pytest.approx(recorded["psnr"], abs=0.01)
    with_warps = found["painters"]["warp"]["total"]
    assert with_warps["painted"]["psnr"] == with_warps["warp_mean"]["psnr"] != unpainted
    with pytest.raises(ConfigError, match=f"one run of each scene, got two of {TOY_SCENE}"):
        score_painters.fn(labels, (), fits=[fit_of_run, fit_of_run])


def test_neighbouring_frames_are_compared_along_every_shift(store, parameters, final):
    shifts = ScoringConfig(shifts=(Shift(lateral_m=1.0),))
    config = replace(parameters.evaluation_config, scoring=shifts)
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


def test_a_report_moves_first_and_says_how_it_is_repeated(store, run):
    page = (store.root / run.result["report"]).read_text("utf-8")
    picture = base64.b64decode(re.search(r"data:image/webp;base64,([^\"]+)", page)[1])
    _, frames = cv2.imdecodeanimation(np.frombuffer(picture, np.uint8))
    assert len(frames.frames) == 4  # all that was recorded
    _, width_px, _ = frames.frames[0].shape
    assert width_px == 2 * PANEL_WIDTH_PX
    left, right = frames.frames[0][:, : width_px // 2], frames.frames[0][:, width_px // 2 :]
    assert left.std() > 10
    assert abs(left.astype(int) - right.astype(int)).mean() > 2  # a step aside
    for earlier, later in pairwise(
        ["data:image/webp", 'class="verdict"', "Worst views", "<h2>Held-out", "How to repeat it"]
    ):
        assert page.index(earlier) < page.index(later)
    assert f"lidarpainter view {run.run_id}" in page
    assert "Car car" in page


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
    (psnr,) = (
        metric
        for metric in metrics
        if [metric[key] for key in ("protocol", "variant", "name")]
        == ["recorded", "painted", "psnr"]
    )
    by_view = json.loads(psnr["by_view"])
    assert set(by_view) == {"front/1", "front/3"}
    assert psnr["value"] == pytest.approx(sum(by_view.values()) / 2)


def test_a_failed_run_says_why(store, parameters):
    asked = parameters.run_spec(store.root)
    record = begin_run.fn(asked, "f" * 16, "b" * 32, "balanced", parameters)
    assert store.tables.row("runs", record.run_id)["status"] == "running"
    end_run.fn(store.root, record, "failed", "SceneError: no image")
    assert store.tables.row("runs", record.run_id)["error"] == "SceneError: no image"


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
    judged = evaluate.fn(asked, "evaluate", run.final, parameters.evaluation_config)
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


def test_a_fit_tells_its_gaussians_in_plain_numbers():
    told = [in_thousands(count) for count in (850, 9_800, 210_400, 3_050_000)]
    assert told == ["850", "9.8k", "210k", "3,050k"]
