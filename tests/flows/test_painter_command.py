"""`lidarpainter painter`: what it refuses, what it prints, and that it trains."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from commands import SMALL_TRAINING, refuse, settings, succeed
from random_pairs import random_pair, write_pairs
from tiny_diffusion import write_model

from catalog.store import STORE_ENVIRONMENT, open_store
from flows.cli.painter import parse_seeds
from flows.painter_parameters import shaped
from lidarpainter_models.painter.nano.network import NanoConfig, NanoNetwork
from lidarpainter_models.painter.nano.training import NanoTrainingConfig
from lidarpainter_models.painter.nano.weights import load_weights, save_weights
from lidarpainter_models.training_data.pairs import PairWriter

SMALL = NanoConfig(widths=(8, 8, 8), blocks=(1, 1, 1))
SMALL_ONE_STEP = settings(
    "training.loss.lpips=0",
    "training.loss.adversarial=0",
    "training.augmentation.crop_px=64",
    "training.accumulated_batches=1",
    "training.log_every_steps=1",
)


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
        (["train", "--seeds", "1000,99"], "street seed 99 is kept for"),
        (["train", "--scene", "synthetic/street-0001"], "street seed 1 is kept for"),
        (["train", "--scene", "../x"], "no scene id"),
        (["train", "--seeds", "1005:1000"], "expected such as 1000:1004"),
        (["train", "--seeds", "1000,1000"], "named twice"),
        (["train", "--seeds", "1000", "--steps", "5", "--budget", "5"], "not both"),
        (["train", "--seeds", "1000", "--inputs", "warp"], "warps the render"),
        (["train", "--pairs", "/nowhere"], "no training pairs in /nowhere"),
        (["train", "--pairs", "/nowhere", "--start", "warp"], "expected a trained painter"),
        (["train", "--seeds", "1000", "--start", "gone.safetensors"], "no painter weights at"),
        (["train", "--seeds", "1000", "--base", "m", "--start", "nano"], "--base or --start"),
        (["train", "--seeds", "1000", "--base", "m", "--inputs", "render"], "small painter"),
        (["train", "--seeds", "1000", "--base", "m"], "the loss weighs LPIPS by 0.2"),
        (["train", "--seeds", "1000", "--lpips-heads", "h.pth"], "are for training with --base"),
        (["train", "--seeds", "1000", "--processes", "2"], "in one process"),
        (["harvest", "--scene", "toy/street", "--set", "harvest.wrong=1"], "no setting"),
        (["info", "--painter", "none.safetensors"], "no painter weights at none.safetensors"),
        (["info", "--painter", "/nowhere:fast"], "no painter '/nowhere:fast'"),
        (["evaluate", "--painter", "none", "--run", "latest"], "no store at"),
        (["ablate", "--pairs-train", "/a", "--pairs-test", "/b", "--table", "x"], "no ablation"),
    ],
)
def test_bad_input_is_one_line_and_code_two(words, expected, own_store):
    assert expected in refuse("painter", *words)
    assert not own_store.root.exists()


def test_pairs_of_a_street_that_judges_are_refused(make_pairs):
    folder = make_pairs("judging", [1], dataset="synthetic", sequence="street-0007")
    assert "street seed 7 is kept for" in refuse("painter", "train", "--pairs", folder)


def test_a_folder_without_any_pair_is_one_line(tmp_path):
    (tmp_path / "index.json").write_text('{"format": "lidarpainter-pair/1", "pairs": []}')
    assert "no training pairs in" in refuse("painter", "train", "--pairs", tmp_path)


def test_info_tells_parts_size_licence_and_origin(tmp_path):
    path = tmp_path / "own.safetensors"
    provenance = {"steps": 3, "trained_targets": ["a", "b"]}
    save_weights(NanoNetwork(SMALL), path, licence="MIT", provenance=provenance)
    found = info(path)
    assert found["num_bytes"] == path.stat().st_size
    assert found["num_parameters"] == sum(found["parameters"].values())
    assert found["num_parameters"] == sum(p.numel() for p in NanoNetwork(SMALL).parameters())
    assert (found["licence"], found["provenance"]) == ("MIT", provenance)
    assert found["architecture"]["inputs"] == ["lidar", "render", "warp"]
    assert "true images trained on" in succeed("painter", "info", "--painter", path).out


def info(painter):
    return succeed("painter", "info", "--painter", painter, "--json").json


def test_info_of_the_bundled_painter_has_its_trainings_in_rows_and_no_dict():
    shown = succeed("painter", "info").out
    assert "{" not in shown
    for text in ("parts", "encode_coarse", "trainings, each begun", "10500", "pairs that the last"):
        assert text in shown


def test_info_of_a_rule_says_that_nothing_is_learnt():
    found = info("warp")
    assert (found["num_parameters"], found["num_bytes"], found["digest"]) == (0, 0, "warp")
    assert found["architecture"]["summary"].startswith("Averages the render")


def test_a_benchmark_times_both_precisions_and_says_which_is_used(tmp_path):
    path = tmp_path / "own.safetensors"
    save_weights(NanoNetwork(SMALL), path, licence="MIT", provenance={})
    words = ("painter", "benchmark", "--painter", path, "--size", "24x16", "--repeats", "1")
    found = succeed(*words, "--json").json
    assert [row["precision"] for row in found["times"]] == ["float32", "bfloat16"]
    assert sum(row["is_chosen"] for row in found["times"]) == 1
    assert ", chosen" in succeed(*words).out


def test_a_model_in_diffusers_layout_is_described_and_judged(make_pairs, tmp_path):
    folder = write_model(tmp_path / "small-turbo")
    found = info(folder)
    assert found["name"] == "one-step"
    assert found["licence"] == "unknown"
    assert found["num_bytes"] > 0
    assert found["architecture"]["timestep"] == 999
    words = ["--painter", f"{folder}:fast", "--pairs", make_pairs("a", [1])]
    judged = succeed("painter", "evaluate", *words, "--json").json["painters"]
    judged = judged[f"{folder}:fast"]["total"]
    assert judged["num_pairs"] == 1


def test_evaluate_prints_every_painter_on_the_same_pairs(make_pairs, tmp_path):
    folders = [make_pairs("a", [1, 2]), make_pairs("b", [3])]
    path = tmp_path / "knows.safetensors"
    provenance = {"trained_targets": ['pandaset/002 [2, "front"]']}
    network = NanoNetwork(replace(SMALL, base_logit=9.0))
    save_weights(network, path, licence="MIT", provenance=provenance)
    painters = ("--painter", "none", "--painter", f"overlay,{path}")
    words = ("painter", "evaluate", *painters, "--pairs", ",".join(folders))
    found = succeed(*words, "--json").json
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
    shown = succeed(*words).out
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


def test_pairs_without_a_reference_serve_only_tables_that_show_none(make_pairs, tmp_path):
    bare = tmp_path / "bare"
    pair = random_pair(5)
    conditions = replace(pair.conditions, reference_rgb=None)
    PairWriter(bare).add("old", replace(pair, conditions=conditions), {})
    words = ("painter", "ablate", "--pairs-train", make_pairs("new", [1]), "--pairs-test", bare)
    assert "old holds no nearest recorded image" in refuse(*words)


def train(*words):
    return succeed("painter", "train", "--steps", "2", *words, "--json").json


@pytest.mark.slow
@pytest.mark.usefixtures("prefect_api")
def test_a_one_step_painter_is_trained_on_a_model(make_pairs, tmp_path, own_store):
    model = write_model(tmp_path / "small-turbo")
    folder = make_pairs("a", range(4), height_px=64, width_px=80)
    words = ("--base", f"{model}:fast", "--pairs", folder, "--held-back", "0.3")
    found = train(*words, "--out", tmp_path / "out", *SMALL_ONE_STEP)
    weights = tmp_path / "out" / "one-step.safetensors"
    assert found["weights"] == str(weights)
    assert Path(found["samples"]).is_file()
    record = json.loads(weights.with_suffix(".json").read_text())
    assert record["config"]["network"]["timestep"] == 199
    assert own_store.tables.row("painters", found["painter_id"])["name"] == "one-step"
    words = ("--painter", weights, "--pairs", folder, "--json")
    judged = succeed("painter", "evaluate", *words).json
    assert judged["pairs"]["a"]["num_judged"] == 2


@pytest.mark.slow
@pytest.mark.usefixtures("prefect_api")
def test_a_painter_is_trained_on_from_its_weights(make_pairs, tmp_path):
    first, then = tmp_path / "first.safetensors", tmp_path / "then.safetensors"
    words = ("--held-back", "0.25", *SMALL_TRAINING)
    train(*words, "--pairs", make_pairs("a", range(4)), "--out", first)
    train(*words, "--pairs", make_pairs("b", range(4, 8)), "--start", first, "--out", then)
    record = json.loads(then.with_suffix(".json").read_text("utf-8"))
    assert record["started_from"]["steps"] == 2
    learnt = [load_weights(path).provenance["trained_targets"] for path in (first, then)]
    assert set(learnt[0]) < set(learnt[1])
