"""Any damage to a nuScenes log is refused with a place, or harms no more than the doctor sees."""

import os
import resource
import shutil
from collections import Counter
from itertools import count

import mutations
import numpy as np
import pytest
from mutations import damaged_bytes, damaged_json, judge

NUM_CASES = 10_000
MAX_MEMORY_BYTES = 2 * 1024**3
PLACES = (".json", ".jpg", ".pcd.bin", "scene-0061")
_ticks = count(1)


@pytest.fixture(autouse=True)
def doctor_asked_once(monkeypatch):
    """Most damage that is not refused leaves the scene as it was: equal digest, equal findings."""
    monkeypatch.setattr(mutations, "check_scene", remembered(mutations.check_scene))


def remembered(check):
    found = {}

    def checked(scene):
        if scene.content_digest not in found:
            found[scene.content_digest] = check(scene)
        return found[scene.content_digest]

    return checked


def damaged_file(log, rng):
    """A file of the log, a table three times of four, and what is to stand in it instead."""
    kinds = (("*/*.json", damaged_json), ("s*/*/*.jpg", damaged_bytes), ("s*/LIDAR_TOP/*", None))
    pattern, damage = kinds[rng.choice(3, p=[0.76, 0.08, 0.16])]
    files = sorted(log.root.glob(pattern))
    file = files[rng.integers(len(files))]
    return file, (damage or damaged_bytes)(file.read_bytes(), rng)


def replace(file, content):
    """Write a file with a time of its own, so that no cache takes it for the one before."""
    file.write_bytes(content)
    os.utime(file, ns=(next(_ticks), next(_ticks)))


def verdict_of(log, seed, folder):
    """How the log is read with one file damaged; the file is as before afterwards."""
    file, damage = damaged_file(log, np.random.default_rng(seed))
    sound = file.read_bytes()
    replace(file, damage.content)
    store = folder / "store"
    places = (*PLACES, str(log.root))
    try:
        return judge(lambda: log.ingest(store), store=store, sandbox=folder, named=places)
    except BaseException as error:
        error.add_note(f"case {seed}: {file.relative_to(log.root)}, {damage.description}")
        raise
    finally:
        replace(file, sound)
        shutil.rmtree(store, ignore_errors=True)


def outcomes_of(log, seeds, folder):
    return Counter(verdict_of(log, seed, folder).outcome for seed in seeds)


@pytest.mark.parametrize("part", range(4))
def test_damaged_logs_end_well(log, tmp_path, part):
    outcomes = outcomes_of(log, range(25 * part, 25 * (part + 1)), tmp_path)
    assert outcomes["refused"] >= 5
    assert outcomes["accepted"] >= 2


@pytest.mark.slow
def test_ten_thousand_damaged_logs_end_well(log, tmp_path, record_property):
    """Long; `-o junit_family=xunit1 --junit-xml=FILE` keeps the counts."""
    outcomes = outcomes_of(log, range(NUM_CASES), tmp_path)
    for outcome, number in outcomes.items():
        record_property(outcome, number)
    assert outcomes.total() == NUM_CASES
    peak_bytes = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    record_property("peak_memory_bytes", peak_bytes)
    assert peak_bytes < MAX_MEMORY_BYTES
