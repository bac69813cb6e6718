"""Training as a stage: resumed, never repeated, its origin written into the weights."""

import json
from dataclasses import replace

import pytest
import torch
from killer import Killer
from random_pairs import write_pairs

from catalog.store import open_store
from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.evaluation.painter_training import TrainingRequest
from lidarpainter_models.painter.augmentation import AugmentationConfig
from lidarpainter_models.painter.nano.network import NanoConfig
from lidarpainter_models.painter.nano.training import NanoTrainingConfig
from lidarpainter_models.painter.nano.weights import load_weights
from lidarpainter_models.training_data.pairs import PairSet
from tasks.painter.evaluate import load_painting_scores, score_held_back, score_painters
from tasks.painter.train import publish_painter, train, training_record, weights_path
from tasks.progress import listening

CONFIG = NanoTrainingConfig(
    network=NanoConfig(widths=(8, 8, 8), blocks=(1, 1, 1)),
    augmentation=AugmentationConfig(crop_px=32),
    steps=4,
    batch_size=2,
    warm_up_steps=2,
    log_every_steps=1,
    checkpoint_every_s=0.0,
)


@pytest.fixture
def pairs(tmp_path):
    write_pairs(tmp_path / "pairs", range(6))
    return (PairSet(name="log", folder=tmp_path / "pairs"),)


@pytest.fixture
def store(tmp_path):
    return open_store(tmp_path / "store")


def request(sets, config=CONFIG, held_back=0.3):
    return TrainingRequest(sets=sets, config=config, held_back=held_back)


def weights_of(store, result):
    network = load_weights(weights_path(store, result.ref)).network
    return torch.cat([parameter.flatten() for parameter in network.parameters()])


def test_training_is_done_once_and_says_what_it_saw(pairs, store):
    first = train.fn(store.root, "train", request(pairs, CONFIG, held_back=0.3))
    again = train.fn(store.root, "train", request(pairs, CONFIG, held_back=0.3))
    assert (first.is_new, again.is_new) == (True, False)
    provenance = load_weights(weights_path(store, first.ref)).provenance
    assert provenance["licence"] == "Apache-2.0"
    assert provenance["attribution"] == ["CC BY 4.0, PandaSet by Hesai and Scale AI"]
    assert provenance["pairs"]["log"]["num_pairs"] == 4
    record = training_record(store, first.ref, None)
    held = set(record["held_back"]["log"])
    assert len(held) == 2
    assert len(provenance["trained_targets"]) == 4
    assert not held & set(provenance["trained_targets"])
    assert record["config"]["steps"] == 4
    other = train.fn(store.root, "train", request(pairs, replace(CONFIG, seed=1), held_back=0.3))
    assert other.is_new


def test_a_killed_training_goes_on_and_ends_bit_for_bit(pairs, store, tmp_path):
    with listening(Killer()), pytest.raises(KeyboardInterrupt):
        train.fn(store.root, "train", request(pairs, CONFIG, held_back=0.3))
    assert list((store.root / "work").glob("*/training.pt"))
    resumed = train.fn(store.root, "train", request(pairs, CONFIG, held_back=0.3))
    other = open_store(tmp_path / "other")
    straight = train.fn(other.root, "train", request(pairs, CONFIG, held_back=0.3))
    assert torch.equal(weights_of(store, resumed), weights_of(other, straight))
    assert not list((store.root / "work").glob("*"))


def test_a_trained_painter_is_judged_and_catalogued(pairs, store):
    trained = train.fn(store.root, "train", request(pairs, CONFIG, held_back=0.3))
    judged = score_held_back.fn(store.root, "judge", weights_path(store, trained.ref), pairs, 0.3)
    scores = load_painting_scores(store, judged.ref)
    assert scores["total"]["num_pairs"] == judged.summary["num_pairs"] == 2
    row = publish_painter.fn(store.root, trained.ref, scores)
    publish_painter.fn(store.root, trained.ref, scores)
    (stored,) = store.tables.rows("painters")
    assert stored["painter_id"] == row["painter_id"]
    record = json.loads(stored["record"])
    assert record["held_back_scores"]["total"]["num_pairs"] == 2
    assert stored["num_bytes"] == weights_path(store, trained.ref).stat().st_size
    # what it learnt from judges it never, nor those it is compared with
    painters = {"none": "none", "nano": str(store.path_of(stored["path"]))}
    found = score_painters.fn(painters, pairs)
    assert found["pairs"]["log"]["num_left_out"] == 4
    none = found["painters"]["none"]["total"]
    assert none["painted"]["psnr"] == none["input"]["psnr"]
    assert list(found["painters"]) == ["none", "nano"]


def test_pairs_without_known_terms_give_weights_without_a_free_licence(store, tmp_path):
    write_pairs(tmp_path / "odd", range(2), dataset="nuscenes", sequence="1")
    sets = (PairSet(name="odd", folder=tmp_path / "odd"),)
    trained = train.fn(store.root, "train", request(sets, replace(CONFIG, steps=1), held_back=0.0))
    licence = load_weights(weights_path(store, trained.ref)).provenance["licence"]
    assert licence == "terms of the training data: nuscenes"


def test_a_changed_pair_stops_the_training(pairs, store):
    path = next(pairs[0].folder.glob("pair-*.safetensors"))
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(DataError, match="has SHA-256"):
        train.fn(store.root, "train", request(pairs, CONFIG, held_back=0.3))
    assert store.tables.rows("artefacts") == []


@pytest.mark.parametrize("number", [0, 2])
def test_sets_need_names_of_their_own(pairs, store, number):
    with pytest.raises(ConfigError, match="under names of their own"):
        train.fn(store.root, "train", request(pairs * number, CONFIG, held_back=0.3))


def test_judging_needs_something_held_back(pairs, store):
    trained = train.fn(store.root, "train", request(pairs, replace(CONFIG, steps=1), held_back=0.0))
    with pytest.raises(ConfigError, match="nothing to judge by"):
        score_held_back.fn(store.root, "judge", weights_path(store, trained.ref), pairs, 0.0)
