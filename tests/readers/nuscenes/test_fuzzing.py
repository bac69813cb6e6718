"""Any damage to a nuScenes log is refused with a place, or harms no more than the doctor sees."""

import pytest
from fuzzing import MAX_MEMORY_BYTES, fuzz, peak_bytes
from mutations import damaged_bytes, damaged_json

NUM_CASES = 10_000
PLACES = (".json", ".jpg", ".pcd.bin", "scene-0061")


def damaged_file(log, rng):
    """A file of the log, a table three times of four, and what is to stand in it instead."""
    kinds = (("*/*.json", damaged_json), ("s*/*/*.jpg", damaged_bytes), ("s*/LIDAR_TOP/*", None))
    pattern, damage = kinds[rng.choice(3, p=[0.76, 0.08, 0.16])]
    files = sorted(log.root.glob(pattern))
    file = files[rng.integers(len(files))]
    return file, (damage or damaged_bytes)(file.read_bytes(), rng)


def fuzz_nuscenes(log, sandbox, seeds):
    """Damage any file of a log."""
    places = (*PLACES, str(log.root))
    return fuzz(
        log.ingest, lambda rng: damaged_file(log, rng), seeds, sandbox=sandbox, named=places
    )


def test_damaged_logs_end_well(log, tmp_path):
    outcomes = fuzz_nuscenes(log, tmp_path, range(25))
    assert outcomes["refused"] >= 5
    assert outcomes["accepted"] >= 2


@pytest.mark.slow
def test_ten_thousand_damaged_logs_end_well(log, tmp_path, record_property):
    """Long; `-o junit_family=xunit1 --junit-xml=FILE` keeps the counts."""
    outcomes = fuzz_nuscenes(log, tmp_path, range(NUM_CASES))
    for outcome, number in outcomes.items():
        record_property(outcome, number)
    assert outcomes["refused"] + outcomes["accepted"] == NUM_CASES
    assert peak_bytes() < MAX_MEMORY_BYTES
