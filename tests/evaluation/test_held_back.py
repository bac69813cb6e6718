"""What trains and what judges stay apart, by true image and by seed."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.evaluation.held_back import (
    TARGETS_KEY,
    PairSubset,
    check_street_seed,
    check_training_pairs,
    check_training_scene,
    hold_back,
    target_of,
    trained_targets,
    unseen_pairs,
)
from lidarpainter_models.painter.examples import PairSource
from lidarpainter_models.training_data.pairs import PairFolder, PairWriter


@pytest.fixture
def make_folder(tmp_path, make_flat_pair):
    def make(name, frames, copies=2, **provenance):
        writer = PairWriter(tmp_path / name)
        for frame in frames:
            for copy in range(copies):
                pair = make_flat_pair(torch.full((20, 20, 3), frame / 255 + copy / 100))
                writer.add(
                    f"p{frame}-fit{copy}",
                    replace(pair),
                    {"dataset": "log", "sequence": "1", "target": [frame, "front"], **provenance},
                )
        return PairFolder(tmp_path / name)

    return make


def targets_of(sets):
    return frozenset().union(*(subset.targets for subset in sets.values()))


def test_no_true_image_is_on_both_sides(make_folder):
    folders = {"a": make_folder("a", range(10)), "b": make_folder("b", range(5, 15))}
    learnt, judged = hold_back(folders, 0.2)
    assert not targets_of(learnt) & targets_of(judged)
    assert len(targets_of(learnt)) + len(targets_of(judged)) == 15
    assert sum(map(len, learnt.values())) + sum(map(len, judged.values())) == 40
    assert len(targets_of({"a": judged["a"]})) >= 2


def test_what_is_held_back_does_not_depend_on_other_folders_or_order(make_folder):
    folder = make_folder("a", range(10))
    turned = make_folder("turned", reversed(range(10)))
    _, alone = hold_back({"a": folder}, 0.3)
    _, other = hold_back({"turned": turned}, 0.3)
    assert alone["a"].targets == other["turned"].targets
    assert len(alone["a"].targets) == 3


def test_nothing_is_held_back_if_nothing_is_asked_for(make_folder):
    folder = make_folder("a", range(3))
    learnt, judged = hold_back({"a": folder}, 0.0)
    assert (len(learnt["a"]), judged) == (6, {})
    only, none = hold_back({"one": make_folder("one", [7])}, 0.5)
    assert (len(only["one"]), none) == (2, {})


@pytest.mark.parametrize("share", [-0.1, 1.0])
def test_impossible_shares_are_refused(make_folder, share):
    with pytest.raises(ConfigError, match=r"must be in \[0, 1\)"):
        hold_back({"a": make_folder("a", range(3))}, share)


def test_a_subset_is_a_source_of_its_own_pairs(make_folder):
    folder = make_folder("a", range(4))
    subset = PairSubset(folder, "mine", [1, 6])
    assert isinstance(subset, PairSource)
    assert torch.equal(subset.read(1).target_rgb, folder.read(6).target_rgb)
    assert subset.size_px(0) == (20, 20)
    assert list(subset.describe()["pairs"]) == [folder.name(1), folder.name(6)]
    assert subset.describe()["set"] == "mine"
    assert len({subset.digest, folder.digest, PairSubset(folder, "mine", [1, 5]).digest}) == 3


def test_copies_of_a_view_share_its_target(tmp_path, make_flat_pair):
    writer = PairWriter(tmp_path)
    pair = make_flat_pair(torch.zeros(20, 20, 3))
    street = {"dataset": "synthetic", "sequence": "street-1000", "cameras": ["front"]}
    for name, provenance in (
        ("a-fit", {}),
        ("a-damaged1", {}),
        ("b-fit", {}),
        ("c", {**street, "frame": 3, "shift": "left-2m"}),
        ("d", {**street, "frame": 3, "shift": "left-2m", "fit_steps": 9}),
        ("e", {**street, "frame": 3, "shift": "left-3m"}),
    ):
        writer.add(name, pair, provenance)
    folder = PairFolder(tmp_path)
    same_a, again_a, other_b, same_c, again_c, other_e = (target_of(folder, i) for i in range(6))
    assert same_a == again_a != other_b
    assert same_c == again_c != other_e
    assert same_c == 'synthetic/street-1000 [3, "front", "left-2m"]'


def test_what_any_painter_knows_judges_none(make_folder):
    folder = make_folder("a", range(4))
    known = [frozenset({'log/1 [0, "front"]'}), frozenset(), frozenset({'log/1 [2, "front"]'})]
    unseen = unseen_pairs({"a": folder}, known)
    assert unseen["a"].targets == {'log/1 [1, "front"]', 'log/1 [3, "front"]'}
    with pytest.raises(DataError, match="no pair of a is left"):
        unseen_pairs({"a": folder}, [*known, unseen["a"].targets])


def test_weights_say_what_they_know_by_targets_or_by_their_sources(make_folder):
    folder = make_folder("a", range(2))
    expected = {'log/1 [0, "front"]', 'log/1 [1, "front"]'}
    assert trained_targets({TARGETS_KEY: sorted(expected)}) == expected
    assert trained_targets({"sources": [folder.describe()]}) == expected
    assert trained_targets({"steps": 5}) is None
    assert trained_targets({"sources": [{"digest": "x"}]}) is None


@pytest.mark.parametrize("seed", [0, 7, 99, 999])
def test_streets_of_low_seeds_never_train(seed):
    with pytest.raises(ConfigError, match=f"street seed {seed} is kept for") as caught:
        check_street_seed(seed)
    assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match="kept for"):
        check_training_scene("synthetic", f"street-{seed:04d}")


def test_of_streets_and_logs_only_those_kept_for_judging_may_not_train():
    scenes = [("synthetic", f"street-{seed:04d}") for seed in (998, 999, 1000, 1001)]
    scenes += [("pandaset", "002"), ("pandaset", "street-0007")]
    refused = []
    for dataset, sequence in scenes:
        try:
            check_training_scene(dataset, sequence)
        except ConfigError:
            refused.append((dataset, sequence))
    assert refused == scenes[:2]


def test_pairs_of_a_street_that_judges_never_train(make_folder):
    check_training_pairs(make_folder("good", [1], dataset="synthetic", sequence="street-1002"))
    bad = make_folder("bad", [1], dataset="synthetic", sequence="street-0007")
    with pytest.raises(ConfigError, match="street seed 7 is kept"):
        check_training_pairs(bad)


def test_what_was_learnt_before_judges_nothing_and_is_still_not_learnt(make_folder):
    folders = {"log": make_folder("log", range(10))}
    learnt, judged = hold_back(folders, 0.3)
    known = sorted(judged["log"].targets)[0]
    again, rest = hold_back(folders, 0.3, known={known})
    assert again["log"].targets == learnt["log"].targets
    assert rest["log"].targets == judged["log"].targets - {known}
