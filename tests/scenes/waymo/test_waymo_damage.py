"""However Waymo's files are damaged: one line with a place, or a scene that can be checked."""

import resource
import shutil
from collections import Counter

import numpy as np
import pytest
from mutations import judge
from waymo_damage import damage_component, damaged_record_file
from waymo_log import SEGMENT, frame_messages, write_v2

from lidarpainter_models.scenes.readers import ingest_scene

FAST_CASES = 15
ALL_CASES = 10_000
MAX_BYTES = 2 << 30


def judge_records(messages, folder, cases, seed):
    """Damage the records of version 1 again and again; count how it ends."""
    outcomes = Counter()
    for case in range(cases):
        damage = damaged_record_file(messages, np.random.default_rng([seed, case]))
        log, store = folder / "log", folder / "store"
        log.mkdir(parents=True)
        (log / f"{SEGMENT}.tfrecord").write_bytes(damage.content)
        outcomes[judged(log, store, folder, f"case {case}, {damage.description}")] += 1
        shutil.rmtree(folder)
    return outcomes


def judge_components(truth, folder, cases, seed):
    """Damage one component of version 2 again and again; count how it ends."""
    sound = write_v2(truth, folder / "sound", rows_per_group=5)
    outcomes = Counter()
    for case in range(cases):
        work = folder / "work"
        shutil.copytree(sound, work / "log")
        description = damage_component(work / "log", np.random.default_rng([seed, case]))
        outcomes[judged(work / "log", work / "store", work, f"case {case}, {description}")] += 1
        shutil.rmtree(work)
    return outcomes


def judged(log, store, sandbox, description):
    store.mkdir()
    try:
        return judge(
            lambda: ingest_scene("waymo", log, SEGMENT, store),
            store=store,
            sandbox=sandbox,
            named=(str(log),),
        ).outcome
    except Exception as error:
        raise AssertionError(f"{description}: {type(error).__name__}: {error}") from error


def peak_bytes():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def test_damaged_records_are_refused_or_read(tiny_truth, tmp_path):
    outcomes = judge_records(frame_messages(tiny_truth), tmp_path / "work", FAST_CASES, seed=1)
    assert outcomes["refused"] > FAST_CASES / 3


def test_damaged_components_are_refused_or_read(tiny_truth, tmp_path):
    outcomes = judge_components(tiny_truth, tmp_path, FAST_CASES, seed=2)
    assert outcomes["refused"] > 1


@pytest.mark.slow
def test_ten_thousand_damaged_record_files(tiny_truth, tmp_path, record_property):
    outcomes = judge_records(frame_messages(tiny_truth), tmp_path / "work", ALL_CASES, seed=3)
    record_property("outcomes", dict(outcomes))
    record_property("peak_bytes", peak_bytes())
    assert outcomes.total() == ALL_CASES
    assert peak_bytes() < MAX_BYTES


@pytest.mark.slow
def test_ten_thousand_damaged_component_folders(tiny_truth, tmp_path, record_property):
    outcomes = judge_components(tiny_truth, tmp_path, ALL_CASES, seed=4)
    record_property("outcomes", dict(outcomes))
    record_property("peak_bytes", peak_bytes())
    assert outcomes.total() == ALL_CASES
    assert peak_bytes() < MAX_BYTES
