"""Training the one-step painter as a stage: what it refuses, keeps and leaves."""

import json
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
import torch
from killer import Killer
from process_ends import still_running
from quiet_augmentation import QUIET
from random_pairs import write_pairs
from tiny_diffusion import write_model

from catalog.store import open_store
from lidarpainter_models.errors import ConfigError, TrainingError, WeightsError
from lidarpainter_models.evaluation.painter_training import TrainingRequest
from lidarpainter_models.metrics.backbones import SQUEEZENET
from lidarpainter_models.metrics.lpips import Lpips
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.painter.losses import PaperLossWeights
from lidarpainter_models.painter.nano.training import NanoTrainingConfig
from lidarpainter_models.painter.one_step.config import FAST
from lidarpainter_models.painter.one_step.training import OneStepTrainingConfig
from lidarpainter_models.painter.selection import load_painter
from lidarpainter_models.painter.training_jobs import job_for, recipe_for
from lidarpainter_models.training_data.pairs import PairSet
from tasks.painter.evaluate import load_painting_scores, samples_path, score_held_back
from tasks.painter.train import publish_painter, train, training_record, weights_path
from tasks.progress import listening

CONFIG = OneStepTrainingConfig(
    network=FAST,
    augmentation=replace(QUIET, crop_px=64),
    loss=PaperLossWeights(lpips=0, adversarial=0),
    steps=2,
    accumulated_batches=1,
    log_every_steps=1,
    checkpoint_every_s=0.0,
)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return str(write_model(tmp_path_factory.mktemp("models") / "small-turbo"))


@pytest.fixture
def pairs(tmp_path):
    write_pairs(tmp_path / "pairs", range(4), height_px=64, width_px=80)
    return (PairSet(name="log", folder=tmp_path / "pairs"),)


@pytest.fixture
def store(tmp_path):
    return open_store(tmp_path / "store")


def request(sets, config, held_back, start, **options):
    return TrainingRequest(sets=sets, config=config, held_back=held_back, start=start, **options)


@pytest.mark.slow
def test_a_one_step_painter_is_trained_judged_published_and_trained_on(pairs, store, model):
    trained = train.fn(store.root, "train", request(pairs, CONFIG, 0.3, model))
    weights = weights_path(store, trained.ref)
    assert weights.name == "one-step.safetensors"
    painter = load_painter(weights)
    assert painter.provenance["licence"].startswith("that of the model underneath (unknown), and")
    assert painter.provenance["base"] == model
    assert len(painter.provenance["trained_targets"]) == 2
    record = training_record(store, trained.ref, None)
    assert record["base_licence"] == "unknown"
    assert record["config"]["network"]["autoencoder"] == "taesd"
    assert [entry["step"] for entry in record["history"]] == [1, 2]
    assert set(record["pairs"][0]["pairs"]) <= {f"pair-{frame}" for frame in range(4)}

    judged = score_held_back.fn(store.root, "judge", weights, pairs, 0.3)
    assert load_painting_scores(store, judged.ref)["total"]["num_pairs"] == 2
    assert samples_path(store, judged.ref).stat().st_size > 1000
    row = publish_painter.fn(store.root, trained.ref, None)
    assert row["name"] == "one-step"
    assert json.loads(row["record"])["training_digest"] == record["training_digest"]

    on = recipe_for(str(weights))
    assert on.network == FAST
    further = replace(CONFIG, steps=1)
    then = train.fn(store.root, "train", request(pairs, further, 0.3, weights))
    told = load_painter(weights_path(store, then.ref)).provenance
    assert told["started_from"]["steps"] == 2
    assert told["base"] == model


@pytest.mark.parametrize(
    ("changes", "start", "options", "expected"),
    [
        ({"loss": PaperLossWeights(adversarial=0)}, "MODEL", {}, "weighs LPIPS by"),
        ({}, "MODEL", {"lpips": LpipsFiles(heads=Path("h.pth"))}, "a backbone not given"),
        ({}, None, {}, "is trained on a model"),
        ({}, "/nowhere/model", {}, "no such folder"),
        ({}, "gone.safetensors", {}, "gone.safetensors is not there"),
        ({"max_cpu_s": 5.0}, "MODEL", {"num_processes": 2}, "cannot share a budget"),
        ({}, "MODEL", {"num_processes": 0}, "cannot share a budget"),
    ],
)
def test_what_cannot_be_trained_is_refused_at_once(model, changes, start, options, expected):
    start = model if start == "MODEL" else start
    with pytest.raises((ConfigError, WeightsError), match=expected) as caught:
        job_for(replace(CONFIG, **changes), start, **options)
    assert "\n" not in str(caught.value)


def test_lpips_enters_the_loss_and_lends_its_features(pairs, store, model, tmp_path, monkeypatch):
    heads = [torch.rand(channels) for channels in SQUEEZENET.channels]
    lpips = Lpips(SQUEEZENET.build(), heads).requires_grad_(False)
    monkeypatch.setattr("lidarpainter_models.painter.one_step.job.load_lpips", lambda _files: lpips)
    files = LpipsFiles(backbone=tmp_path / "backbone", heads=tmp_path / "heads")
    for path in (files.backbone, files.heads):
        path.write_bytes(b"stands for weights")
    config = replace(CONFIG, steps=1, loss=PaperLossWeights())
    trained = train.fn(store.root, "train", request(pairs, config, 0.0, model, lpips=files))
    record = training_record(store, trained.ref, None)
    assert record["discriminator"] == "FeatureDiscriminator"
    assert record["history"][0]["lpips"] > 0
    assert {"lpips backbone", "lpips heads"} <= set(record)


def test_the_small_painter_is_trained_alone():
    with pytest.raises(ConfigError, match="one process"):
        job_for(NanoTrainingConfig(), None, num_processes=2)


@pytest.mark.slow
def test_two_processes_train_one_painter(pairs, store, model):
    config = replace(CONFIG, half_precision=False)
    two = train.fn(store.root, "train", request(pairs, config, 0.0, model, num_processes=2))
    one = replace(config, accumulated_batches=2)
    alone = train.fn(store.root, "train", request(pairs, one, 0.0, model))
    records = [training_record(store, made.ref, None) for made in (two, alone)]
    assert [record["processes"] for record in records] == [2, 1]
    for ours, theirs in zip(*(record["history"] for record in records), strict=True):
        assert ours["total"] == pytest.approx(theirs["total"], rel=1e-4)


class WorkerKiller(Killer):
    """Kills one of the processes that torchrun has started, once there is a checkpoint."""

    def __init__(self):
        self.processes = []

    def advanced(self, _stage, _done, _total, note):
        if note.startswith("step 2"):
            self.processes = psutil.Process().children(recursive=True)
            next(one for one in self.processes if not one.children()).kill()


@pytest.mark.slow
def test_a_lost_process_ends_the_training_with_one_line(pairs, store, model):
    config = replace(CONFIG, steps=50)
    killer = WorkerKiller()
    with (
        listening(killer),
        pytest.raises(TrainingError, match="in several processes broke off") as caught,
    ):
        train.fn(store.root, "train", request(pairs, config, 0.0, model, num_processes=2))
    assert "\n" not in str(caught.value)
    assert list((store.root / "work").glob("*/training.pt"))
    assert still_running(killer.processes) == []


@pytest.mark.slow
def test_an_interrupted_training_leaves_no_process_behind(pairs, store, model):
    started = []

    class Interrupter(Killer):
        def advanced(self, _stage, _done, _total, _note):
            started.extend(psutil.Process().children(recursive=True))
            raise KeyboardInterrupt

    config = replace(CONFIG, steps=50)
    with listening(Interrupter()), pytest.raises(KeyboardInterrupt):
        train.fn(store.root, "train", request(pairs, config, 0.0, model, num_processes=2))
    assert started
    assert still_running(started) == []


@pytest.mark.slow
def test_what_stops_several_processes_is_said_in_one_line(pairs, store, model):
    beyond_float32 = PaperLossWeights(lpips=0, adversarial=0, squared=1e39)
    config = replace(CONFIG, loss=beyond_float32)
    with pytest.raises(TrainingError, match="the training stops") as caught:
        train.fn(store.root, "train", request(pairs, config, 0.0, model, num_processes=2))
    assert "\n" not in str(caught.value)
