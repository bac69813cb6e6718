"""`lidarpainter painter`: what it refuses, what it prints, and that it trains."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from random_pairs import random_pair, write_pairs
from tiny_diffusion import write_model

from catalog.store import STORE_ENVIRONMENT, open_store
from flows.cli.main import main
from flows.cli.painter import parse_seeds
from flows.painter_parameters import shaped
from lidarpainter_models.painter.nano.network import NanoConfig, NanoNetwork
from lidarpainter_models.painter.nano.training import NanoTrainingConfig
from lidarpainter_models.painter.nano.weights import load_weights, save_weights
from lidarpainter_models.training_data.pairs import PairWriter

ROOT = Path(__file__).resolve().parents[2]
SMALL = NanoConfig(widths=(8, 8, 8), blocks=(1, 1, 1))
SMALL_TRAINING = [
    "--set",
    "training.network.widths=8,8,8",
    "--set",
    "training.network.blocks=1,1,1",
    "--set",
    "training.augmentation.crop_px=32",
    "--set",
    "training.batch_size=2",
    "--set",
    "training.log_every_steps=1",
]


@pytest.fixture(autouse=True)
def own_store(tmp_path, monkeypatch):
    monkeypatch.setenv(STORE_ENVIRONMENT, str(tmp_path / "store"))
    return open_store(tmp_path / "store")


@pytest.fixture
def make_pairs(tmp_path):
    """Write a folder of pairs of some frames; returns its path as text."""

    def make(name, frames, **place):
        write_pairs(tmp_path / name, frames, **place)
        return str(tmp_path / name)

    return make


def test_seeds_may_be_listed_and_ranged():
    assert parse_seeds(None) == ()
    assert parse_seeds("1000:1003,1010") == (1000, 1001, 1002, 1010)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["train"], "nothing to train on"),
        (["train", "--seeds", "7"], "street seed 7 is kept for"),
        (["train", "--seeds", "1000,99"], "street seed 99 is kept for"),
        (["train", "--scene", "synthetic/street-0001"], "street seed 1 is kept for"),
        (["train", "--scene", "../x"], "no scene id"),
        (["train", "--seeds", "ten"], "expected such as 1000:1004"),
        (["train", "--seeds", "1005:1000"], "expected such as 1000:1004"),
        (["train", "--seeds", "1000,1000"], "named twice"),
        (["train", "--seeds", "1000", "--steps", "5", "--budget", "5"], "not both"),
        (["train", "--seeds", "1000", "--steps", "0"], "steps must be positive"),
        (["train", "--seeds", "1000", "--budget", "-1"], "max_cpu_s must be positive"),
        (["train", "--seeds", "1000", "--inputs", "radar"], "inputs must be of"),
        (["train", "--seeds", "1000", "--inputs", "warp"], "warps the render"),
        (["train", "--pairs", "/nowhere"], "no training pairs in /nowhere"),
        (["train", "--pairs", "/nowhere", "--start", "warp"], "expected a trained painter"),
        (["train", "--seeds", "1000", "--start", "gone.safetensors"], "no painter weights at"),
        (
            ["train", "--seeds", "1000", "--base", "/nowhere", "--set", "training.loss.lpips=0"],
            "no painter '/nowhere'",
        ),
        (["train", "--seeds", "1000", "--base", "m", "--start", "nano"], "--base or --start"),
        (["train", "--seeds", "1000", "--base", "m", "--inputs", "render"], "small painter"),
        (["train", "--seeds", "1000", "--base", "m"], "the loss weighs LPIPS by 0.2"),
        (["train", "--seeds", "1000", "--lpips-heads", "h.pth"], "are for training with --base"),
        (["train", "--seeds", "1000", "--processes", "2"], "in one process"),
        (["harvest"], "nothing to harvest"),
        (["harvest", "--scene", "toy/street", "--set", "harvest.wrong=1"], "no setting"),
        (["info", "--painter", "picasso"], "no painter 'picasso'"),
        (["info", "--painter", "none.safetensors"], "no painter weights at none.safetensors"),
        (["info", "--painter", "/nowhere:fast"], "no painter '/nowhere:fast'"),
        (["benchmark", "--painter", "picasso"], "no painter 'picasso'"),
        (["benchmark", "--size", "0x5"], "expected such as 1024x576"),
        (
            ["evaluate", "--painter", "none", "--pairs", "/a", "--device", "cuda"],
            "no CUDA device",
        ),
        (["evaluate", "--painter", "none", "--pairs", "/nowhere"], "no training pairs in /nowhere"),
        (["evaluate", "--painter", "none"], "nothing to judge by: expected --pairs or --run"),
        (["evaluate", "--painter", "none", "--run", "latest"], "no store at"),
        (["evaluate", "--painter", "none,none", "--pairs", "/nowhere"], "expected each once"),
        (["ablate", "--pairs-train", "/nowhere", "--pairs-test", "/else"], "no training pairs in"),
        (["ablate", "--pairs-train", "/a", "--pairs-test", "/b", "--table", "x"], "no ablation"),
    ],
)
def test_bad_input_is_one_line_and_code_two(words, expected, capsys, own_store):
    assert main(["painter", *words]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert expected in captured.err
    assert captured.err.count("\n") == 1
    assert not own_store.root.exists()


def test_pairs_of_a_street_that_judges_are_refused(make_pairs, capsys):
    folder = make_pairs("judging", [1], dataset="synthetic", sequence="street-0007")
    assert main(["painter", "train", "--pairs", folder]) == 2
    assert "street seed 7 is kept for" in capsys.readouterr().err


def test_a_folder_without_any_pair_is_one_line(tmp_path, capsys):
    folder = tmp_path / "empty"
    folder.mkdir()
    (folder / "index.json").write_text('{"format": "lidarpainter-pair/1", "pairs": []}')
    assert main(["painter", "train", "--pairs", str(folder)]) == 2
    assert capsys.readouterr().err.count("no training pairs in") == 1


def test_info_tells_parts_size_licence_and_origin(tmp_path, capsys):
    path = tmp_path / "own.safetensors"
    provenance = {"steps": 3, "trained_targets": ["a", "b"]}
    save_weights(NanoNetwork(SMALL), path, licence="MIT", provenance=provenance)
    assert main(["painter", "info", "--painter", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["num_bytes"] == path.stat().st_size
    assert found["num_parameters"] == sum(found["parameters"].values())
    assert found["num_parameters"] == sum(p.numel() for p in NanoNetwork(SMALL).parameters())
    assert (found["licence"], found["provenance"]) == ("MIT", provenance)
    assert found["architecture"]["inputs"] == ["lidar", "render", "warp"]
    assert main(["painter", "info", "--painter", str(path)]) == 0
    assert "true images trained on" in capsys.readouterr().out


def test_info_of_the_bundled_painter_has_its_trainings_in_rows_and_no_dict(capsys):
    assert main(["painter", "info"]) == 0
    shown = capsys.readouterr().out
    assert "{" not in shown
    for text in ("parts", "encode_coarse", "trainings, each begun", "10500", "pairs that the last"):
        assert text in shown


def test_info_of_a_rule_says_that_nothing_is_learnt(capsys):
    assert main(["painter", "info", "--painter", "warp", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["num_parameters"], found["num_bytes"], found["digest"]) == (0, 0, "warp")
    assert found["architecture"]["summary"].startswith("Averages the render")


def test_a_benchmark_times_both_precisions_and_says_which_is_used(tmp_path, capsys):
    path = tmp_path / "own.safetensors"
    save_weights(NanoNetwork(SMALL), path, licence="MIT", provenance={})
    words = ["painter", "benchmark", "--painter", str(path), "--size", "24x16", "--repeats", "1"]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [row["precision"] for row in found["times"]] == ["float32", "bfloat16"]
    assert sum(row["is_chosen"] for row in found["times"]) == 1
    assert main(words) == 0
    assert ", chosen" in capsys.readouterr().out


def test_a_model_in_diffusers_layout_is_described_and_judged(make_pairs, tmp_path, capsys):
    folder = str(write_model(tmp_path / "small-turbo"))
    assert main(["painter", "info", "--painter", folder, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["name"] == "one-step"
    assert found["licence"] == "unknown"
    assert found["num_bytes"] > 0
    assert found["architecture"]["timestep"] == 999
    words = ["--painter", f"{folder}:fast", "--pairs", make_pairs("a", [1])]
    assert main(["painter", "evaluate", *words, "--json"]) == 0
    judged = json.loads(capsys.readouterr().out)["painters"][f"{folder}:fast"]["total"]
    assert judged["num_pairs"] == 1


def test_evaluate_prints_every_painter_on_the_same_pairs(make_pairs, tmp_path, capsys):
    folders = [make_pairs("a", [1, 2]), make_pairs("b", [3])]
    path = tmp_path / "knows.safetensors"
    provenance = {"trained_targets": ['pandaset/002 [2, "front"]']}
    network = NanoNetwork(replace(SMALL, base_logit=9.0))
    save_weights(network, path, licence="MIT", provenance=provenance)
    words = ["--painter", "none", "--painter", f"overlay,{path}", "--pairs", ",".join(folders)]
    assert main(["painter", "evaluate", *words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found["painters"]) == ["none", "overlay", str(path)]
    assert found["pairs"]["a"]["num_judged"] == 1
    assert found["pairs"]["a"]["num_left_out"] == 1
    none, nano = found["painters"]["none"], found["painters"][str(path)]
    assert none["total"]["painted"]["psnr"] == none["total"]["input"]["psnr"]
    assert none["total"]["num_pairs"] == nano["total"]["num_pairs"] == 2
    # an untrained network with so high a base logit gives the mean of render and warps
    expected = nano["total"]["warp_mean"]["psnr"]
    assert nano["total"]["painted"]["psnr"] == pytest.approx(expected, abs=0.05)
    assert found["training_unknown"] == []
    assert main(["painter", "evaluate", *words]) == 0
    shown = capsys.readouterr().out
    assert "a: 1 pairs left out" in shown
    assert "mean with warps" in shown


def test_length_and_inputs_change_nothing_else():
    default = NanoTrainingConfig()
    both = default.network.inputs
    assert shaped(default, inputs=both) == default
    assert shaped(default, inputs=both, budget_s=60.0).max_cpu_s == 60.0
    fewer = shaped(default, inputs=frozenset({"render"}), steps=5)
    assert (fewer.steps, fewer.network.inputs) == (5, {"render"})
    assert replace(fewer.network, inputs=both) == default.network


def run_command(*words):
    """In a process of its own: Prefect does not survive the loss of one server for another."""
    command = [sys.executable, "-m", "flows.cli", "painter", *words, "--json"]
    answer = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    return json.loads(answer.stdout)


@pytest.mark.slow
def test_train_writes_weights_record_and_catalog_row(make_pairs, tmp_path, own_store):
    folder = make_pairs("a", range(6))
    words = ["--pairs", folder, "--steps", "3", "--held-back", "0.3", "--out", tmp_path / "out"]
    found = run_command("train", *map(str, words), *SMALL_TRAINING)
    weights = tmp_path / "out" / "nano.safetensors"
    record = json.loads((tmp_path / "out" / "nano.json").read_text())
    assert found["weights"] == str(weights)
    assert record["steps"] == 3
    assert record["held_back_scores"]["total"]["num_pairs"] == 2
    row = own_store.tables.row("painters", found["painter_id"])
    assert json.loads(row["record"])["training_digest"] == record["training_digest"]
    # the pairs it learnt from judge it never
    judged = run_command("evaluate", "--painter", str(weights), "--pairs", folder)
    assert judged["pairs"]["a"]["num_judged"] == 2


def test_pairs_without_a_reference_serve_only_tables_that_show_none(make_pairs, tmp_path, capsys):
    bare = tmp_path / "bare"
    pair = random_pair(5)
    conditions = replace(pair.conditions, reference_rgb=None)
    PairWriter(bare).add("old", replace(pair, conditions=conditions), {})
    words = ["painter", "ablate", "--pairs-train", make_pairs("new", [1])]
    assert main([*words, "--pairs-test", str(bare)]) == 2
    told = capsys.readouterr().err
    assert "old holds no nearest recorded image" in told
    assert told.count("\n") == 1


@pytest.mark.slow
def test_ablate_puts_all_variants_beside_the_rules(make_pairs):
    learn, judge = make_pairs("learn", range(3)), make_pairs("judge", range(5, 7))
    words = ["--pairs-train", learn, "--pairs-test", judge, "--steps", "2"]
    found = run_command("ablate", *words, *SMALL_TRAINING)
    full = "render+lidar+warp"
    assert list(found["tables"]["inputs"])[:8] == [
        "none",
        "overlay",
        "warp",
        "lidar+reference",
        "lidar",
        "render+reference",
        "render",
        "render+lidar",
    ]
    assert list(found["tables"]["fusion"])[3:] == [full, f"{full}, direct"]
    assert list(found["tables"]["lidar"])[3:] == [full, f"{full}, composite"]
    assert list(found["tables"]["skips"])[3:] == [full, f"{full}, no skips"]
    shown = {label for rows in found["tables"].values() for label in rows.values()}
    assert set(found["painters"]) == shown
    assert {one["total"]["num_pairs"] for one in found["painters"].values()} == {2}
    lidar_only = load_weights(Path(found["weights"]["lidar"]))
    assert lidar_only.network.config.inputs == {"lidar"}


SMALL_ONE_STEP = [
    "--set",
    "training.loss.lpips=0",
    "--set",
    "training.loss.adversarial=0",
    "--set",
    "training.augmentation.crop_px=64",
    "--set",
    "training.accumulated_batches=1",
    "--set",
    "training.log_every_steps=1",
]


@pytest.mark.slow
def test_a_one_step_painter_is_trained_on_a_model(make_pairs, tmp_path, own_store):
    model = write_model(tmp_path / "small-turbo")
    folder = make_pairs("a", range(4), height_px=64, width_px=80)
    words = ["--base", f"{model}:fast", "--pairs", folder, "--steps", "2", "--held-back", "0.3"]
    found = run_command("train", *words, "--out", str(tmp_path / "out"), *SMALL_ONE_STEP)
    weights = tmp_path / "out" / "one-step.safetensors"
    assert found["weights"] == str(weights)
    assert Path(found["samples"]).is_file()
    record = json.loads(weights.with_suffix(".json").read_text())
    assert record["config"]["network"]["timestep"] == 199
    assert own_store.tables.row("painters", found["painter_id"])["name"] == "one-step"
    judged = run_command("evaluate", "--painter", str(weights), "--pairs", folder)
    assert judged["pairs"]["a"]["num_judged"] == 2


@pytest.mark.slow
def test_a_painter_is_trained_on_from_its_weights(make_pairs, tmp_path):
    first, then = tmp_path / "first.safetensors", tmp_path / "then.safetensors"
    words = ["painter", "train", "--steps", "2", "--held-back", "0.25", "--json", *SMALL_TRAINING]
    assert main([*words, "--pairs", make_pairs("a", range(4)), "--out", str(first)]) == 0
    words += ["--pairs", make_pairs("b", range(4, 8)), "--start", str(first)]
    assert main([*words, "--out", str(then)]) == 0
    record = json.loads(then.with_suffix(".json").read_text("utf-8"))
    assert record["started_from"]["steps"] == 2
    learnt = [load_weights(path).provenance["trained_targets"] for path in (first, then)]
    assert set(learnt[0]) < set(learnt[1])
