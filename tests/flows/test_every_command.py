"""Every command gets a tiny street to its end, and says and writes what it should."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import seen_image, succeed
from tiny_street import (
    FRONT,
    HEIGHT_PX,
    NUM_FRAMES,
    QUICK_LIDAR,
    SCENE,
    SIDE,
    TINY,
    WIDTH_PX,
    reconstructed,
)

from flows import lidar
from flows.cli.evaluate import NEURAD, PROTOCOLS
from lidarpainter_models.export.images import read_image
from lidarpainter_models.painter.styles import STYLE_PROMPTS
from tasks.reconstruction.report import WORST_FILE

ROOT = Path(__file__).resolve().parents[2]
STAGES = (
    *("prepare", "fit", "paint-1", "refine-1"),
    *("examine", "evaluate-unpainted", "evaluate", "envelope", "report"),
)
SHIFTS = {"left-2m", "up-1.5m"}


def numbers_below(value):
    """Every number in a JSON object."""
    if isinstance(value, dict):
        return [number for part in value.values() for number in numbers_below(part)]
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return [value] if is_number else []


# --- demo and reconstruct


def test_demo_tells_what_the_contract_of_the_command_lists(tiny_run):
    result = tiny_run.result
    assert (result["scene"], result["preset"], result["painter"]) == (SCENE, "brief", "nano")
    assert set(result["seconds"]) == {*STAGES, "total"}
    assert all(seconds >= 0 for seconds in result["seconds"].values())
    assert set(STAGES) - {"report"} <= set(result["computed_now"])
    assert all(result["computed_now"].values())
    assert result["peak_memory_bytes"] > 1e8
    assert 500 < result["num_gaussians"] <= 2000
    for scores in (result, result["unpainted"]):
        recorded = scores["recorded"]
        assert recorded["num_views"] == NUM_FRAMES // 2
        # 19.6 painted and 19.3 before it; a grey image has 10
        assert recorded["psnr"] > 18.7
        assert recorded["recorded_poses"]["psnr"] > 18.7
        assert 0.6 < recorded["ssim"] <= 1
        assert recorded["lpips"] is None
        assert "weights" in recorded["lpips_reason"]
        assert set(scores["novel"]) == SHIFTS
        for novel in scores["novel"].values():
            assert 16 < novel["psnr"] < recorded["psnr"]
    assert result["novel"] != result["unpainted"]["novel"]


def test_demo_ends_with_a_page_and_progress_for_every_stage(tiny_run):
    page = Path(tiny_run.result["report"])
    assert page == tiny_run.out / "report.html"
    text = page.read_text("utf-8")
    assert text.startswith("<!doctype html>")
    assert tiny_run.run_id in text
    drive = Path(tiny_run.result["page"])
    assert drive == tiny_run.out / "drive.html"
    assert SCENE in drive.read_text("utf-8")
    for stage in STAGES:
        assert f"\n{stage}: " in f"\n{tiny_run.progress}"
    worst = read_image(Path(tiny_run.result["artefacts"]["report"]) / WORST_FILE)
    assert worst.shape == (HEIGHT_PX, 2 * WIDTH_PX, 3)


def test_catalog_holds_what_the_demo_made_and_nothing_else(tiny_run):
    rows = tiny_run.rows
    (scene,), (run,) = rows["scenes"], rows["runs"]
    assert (scene["scene_id"], scene["num_frames"]) == (SCENE, NUM_FRAMES)
    assert set(scene["cameras"]) == {FRONT, SIDE}
    assert (run["run_id"], run["status"]) == (tiny_run.run_id, "complete")
    assert json.loads(run["result"])["recorded"] == tiny_run.result["recorded"]
    assert len(rows["artefacts"]) == len(STAGES)
    assert rows["painters"] == []
    judged = {(row["variant"], row["trajectory"]) for row in rows["metrics"]}
    assert {(variant, shift) for variant in ("painted", "unpainted") for shift in SHIFTS} <= judged
    for row in rows["metrics"]:
        assert row["run_id"] == tiny_run.run_id
        if row["name"] == "psnr":
            assert (row["value"] is None) == bool(row["reason"])


def test_the_same_again_computes_nothing(tiny_run):
    again = reconstructed(tiny_run, "--json").json
    assert again["run_id"] == tiny_run.run_id
    assert not any(again["computed_now"].values())
    for name in ("recorded", "novel", "unpainted", "num_gaussians", "artefacts"):
        assert again[name] == tiny_run.result[name], name


def test_a_run_may_go_unjudged_and_be_judged_later(tiny_run):
    answer = reconstructed(tiny_run, "--no-evaluate", "--no-report", "--seed", "3", "--json")
    result = answer.json
    assert not {"evaluate", "evaluate-unpainted", "envelope", "report"} & result["seconds"].keys()
    judged = ("recorded", "novel", "recorded_by_camera", "unpainted", "view_time", "envelope")
    for name in (*judged, "report"):
        assert result[name] is None, name
    assert result["computed_now"]["fit"]  # another order of views
    assert not result["computed_now"]["prepare"]
    assert reconstructed(tiny_run, "--no-evaluate", "--no-report", "--seed", "3").code == 0
    run_id = result["run_id"]
    assert tiny_run.store.run(run_id)["status"] == "complete"
    judged = succeed("evaluate", run_id, "--json", store=tiny_run.store).json
    assert judged["painted"]["recorded"]["psnr"] > 18.7


def test_every_stage_tells_how_far_it_is_from_its_start_to_its_end(tiny_run, monkeypatch):
    monkeypatch.setattr("flows.cli.progress.LINE_EVERY_S", 0.0)
    said = reconstructed(tiny_run, "--seed", "4", "--set", "observation.width_px=90").err
    told = {
        stage: [line for line in said.splitlines() if line.startswith(f"{stage}: ")]
        for stage in STAGES
        if stage != "examine"  # as another run of the scene has left it
    }
    for stage, lines in told.items():
        assert len(lines) > 2, stage
        assert f"{stage}: stage " in lines[0], stage
        # a stage is whole when it is over; a round ends with weighing what it gained
        assert (" 99 %, " in lines[-2]) != ("whether views became better" in lines[-2]), stage
        assert lines[-1].endswith(" s"), stage
        assert all("; run " in line for line in lines[:-1]), stage
    assert " 0 %, " in told["fit"][1]
    assert [line.rpartition(", ")[2] for line in told["fit"][2:4]] == ["25 %", "50 %"]
    assert "0:00" not in said


def test_a_report_does_without_scores(tiny_run):
    result = reconstructed(tiny_run, "--no-evaluate", "--json").json
    assert not any(new for name, new in result["computed_now"].items() if name != "report")
    text = Path(result["report"]).read_text("utf-8")
    assert "Stages" in text
    assert "Held-out views" not in text


def test_seconds_are_those_of_the_computation_however_often_it_is_asked_for(tiny_run):
    row = tiny_run.store.run(tiny_run.run_id)
    again = reconstructed(tiny_run, "--json").json
    assert tiny_run.store.run(tiny_run.run_id) == row
    partly = reconstructed(tiny_run, "--no-report", "--json").json  # other parameters, other run
    assert partly["run_id"] != again["run_id"]
    for stage, seconds in partly["seconds"].items():
        if stage != "total":
            assert seconds == again["seconds"][stage] == tiny_run.result["seconds"][stage], stage


def test_verbose_says_what_a_stage_depends_on_and_quiet_nothing(tiny_run):
    words = ("evaluate", tiny_run.run_id)
    loud = succeed(*words, "-v", store=tiny_run.store).err
    assert "was there; from scene " in loud
    assert str(tiny_run.store.root / "artefacts" / "evaluation") in loud
    assert succeed(*words, "--quiet", store=tiny_run.store).err == ""
    assert "lies in" not in succeed(*words, store=tiny_run.store).err


def test_the_installed_command_finds_the_run_in_a_process_of_its_own(tiny_run, tmp_path):
    """The entry point, its environment and a Prefect server that it starts and ends itself."""
    words = ["--store", tiny_run.store.root, "reconstruct", SCENE, "--json", *TINY]
    environment = {**os.environ, "PREFECT_HOME": str(tmp_path)}
    environment.pop("PREFECT_API_URL", None)
    answer = subprocess.run(
        [sys.executable, "-m", "flows.cli", *map(str, words)],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 0, answer.stderr
    again = json.loads(answer.stdout)
    assert again["run_id"] == tiny_run.run_id
    assert not any(again["computed_now"].values())


def test_a_person_is_shown_tables(tiny_run):
    shown = reconstructed(tiny_run).out
    for text in (SCENE, tiny_run.run_id, "left-2m", "Gaussians", "report.html"):
        assert text in shown
    assert f"{tiny_run.result['recorded']['psnr']:.3f}" in shown


# --- seeing and judging a run


@pytest.mark.parametrize(
    ("trajectory", "words", "painter"),
    [
        ("recorded", ("--camera", FRONT), None),
        ("lateral:1", ("--postpaint", "--previous", "mixed"), "nano"),
        ("up:0.5+yaw:5", ("--painter", "overlay"), "overlay"),
    ],
)
def test_render_writes_images_along_the_path(tiny_run, tmp_path, trajectory, words, painter):
    words = ("--trajectory", trajectory, "--frames", "1:4", "--out", tmp_path, *words)
    result = succeed("render", tiny_run.run_id, *words, "--json", store=tiny_run.store).json
    assert (result["run_id"], result["trajectory"]) == (tiny_run.run_id, trajectory)
    assert (result["painter"], result["num_images"]) == (painter, 3)
    described = json.loads((tmp_path / "trajectory.json").read_text())["images"]
    images = [seen_image(tmp_path / row["file"], WIDTH_PX, HEIGHT_PX) for row in described]
    assert not np.array_equal(images[0], images[2])
    for row, image in zip(described, images, strict=True):
        assert ("unpainted" in row) == (painter is not None)
        assert 0 <= row["confidence"] <= 1
        if painter:
            render = seen_image(tmp_path / row["unpainted"], WIDTH_PX, HEIGHT_PX)
            assert not np.array_equal(render, image)


def test_a_shifted_camera_stands_where_it_was_asked_to(tiny_run, tmp_path):
    poses = {}
    for trajectory in ("recorded", "lateral:2"):
        out = tmp_path / trajectory
        words = ("--trajectory", trajectory, "--frames", "2:3", "--out", out)
        assert f"images of {SCENE}" in succeed("render", "latest", *words, store=tiny_run.store).out
        (row,) = json.loads((out / "trajectory.json").read_text())["images"]
        poses[trajectory] = np.array(row["world_from_camera"]).reshape(4, 4)
    moved_m = poses["lateral:2"][:3, 3] - poses["recorded"][:3, 3]
    assert np.linalg.norm(moved_m) == pytest.approx(2.0, abs=1e-3)
    assert poses["recorded"][:3, 0] @ moved_m == pytest.approx(-2.0, abs=0.02)  # x is to the right


@pytest.mark.parametrize("protocol", [name for name in PROTOCOLS if name != NEURAD])
def test_evaluate_judges_by_every_protocol_and_only_once(tiny_run, protocol, monkeypatch):
    monkeypatch.setattr(lidar, "LidarConfig", QUICK_LIDAR)
    words = ("evaluate", tiny_run.run_id, "--protocol", protocol)
    first, again = (succeed(*words, "--json", store=tiny_run.store) for _ in range(2))
    result = first.json
    assert again.json == result
    assert (result["run_id"], result["scene"]) == (tiny_run.run_id, SCENE)
    assert result["protocol"] == protocol
    found = numbers_below(result)
    assert len(found) > 3
    assert all(math.isfinite(number) for number in found)
    shown = succeed(*words, store=tiny_run.store)
    assert tiny_run.run_id in shown.out
    assert "was there" in shown.err


def test_paper_protocol_gives_the_figures_of_the_run(tiny_run):
    words = ("evaluate", tiny_run.run_id, "--protocol", "paper", "--json")
    result = succeed(*words, store=tiny_run.store).json
    assert result["painted"]["recorded"] == tiny_run.result["recorded"]
    assert result["unpainted"] == tiny_run.result["unpainted"]


def test_cross_camera_judges_by_the_camera_that_was_left_out(tiny_run):
    words = ("evaluate", tiny_run.run_id, "--protocol", "cross-camera", "--json")
    result = succeed(*words, store=tiny_run.store).json
    for variant in ("unpainted", "painted"):
        assert list(result[variant]) == [SIDE]
        scores = result[variant][SIDE]
        assert scores["num_views"] == NUM_FRAMES // 2
        assert scores["num_pixels"] > 500
        assert scores["psnr"] > 19.3  # 19.9, and 20.2 after painting
        assert scores["psnr"] > scores["uncalibrated_psnr"]
    strips = (result[variant][SIDE]["psnr"] for variant in ("unpainted", "painted"))
    assert next(strips) < next(strips)


def test_flicker_compares_what_was_rendered_painted_and_true(tiny_run):
    before = tiny_run.store.tables.rows("metrics")
    words = ("evaluate", tiny_run.run_id, "--protocol", "flicker", "--painter", "overlay")
    result = succeed(*words, "--previous", "mixed", "--json", store=tiny_run.store).json
    for images in result["flicker"].values():
        assert {"render", "painted", "truth", "painted, previous mixed"} <= set(images)
        assert 0 < images["render"]["flicker"] < images["painted"]["flicker"]
    assert tiny_run.store.tables.rows("metrics") == before  # the run's own painter is another


def test_view_time_painting_is_judged_beside_the_run(tiny_run):
    before = tiny_run.store.tables.rows("metrics")
    words = ("evaluate", tiny_run.run_id, "--painter", "overlay", "--json")
    result = succeed(*words, store=tiny_run.store).json
    assert result["view-time"]["novel"] != result["painted"]["novel"]
    assert set(result["view-time"]["novel"]) == SHIFTS
    assert tiny_run.store.tables.rows("metrics") == before  # the run's own painter is another


@pytest.mark.parametrize("prompt", STYLE_PROMPTS)
def test_stylize_shows_every_style_beside_the_clear_image(tiny_run, tmp_path, prompt):
    words = ("--prompt", prompt, "--frames", "2:3", "--out", tmp_path)
    result = succeed("stylize", tiny_run.run_id, *words, "--json", store=tiny_run.store).json
    assert (result["prompt"], result["num_images"]) == (f"{prompt}:1", 1)
    (row,) = json.loads((tmp_path / "trajectory.json").read_text())["images"]
    styled = seen_image(tmp_path / row["file"], WIDTH_PX, HEIGHT_PX)
    clear = seen_image(tmp_path / "clear" / row["file"], WIDTH_PX, HEIGHT_PX)
    assert np.array_equal(styled, clear) == (prompt == "clear")
    brightness = {"night": (0, 0.7), "foggy": (0.7, 3), "rain": (0.3, 1.5), "clear": (1, 1)}
    low, high = brightness[prompt]
    assert low <= styled.mean() / clear.mean() <= high
