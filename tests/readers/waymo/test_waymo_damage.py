"""However Waymo's files are damaged: one line with a place, or a scene that can be checked."""

import pytest
from fuzzing import MAX_MEMORY_BYTES, fuzz, peak_bytes
from waymo_components import write_v2
from waymo_damage import damaged_component, damaged_record_file
from waymo_numbers import SEGMENT
from waymo_records import frame_messages, write_v1

from lidarpainter_models.readers import ingest_scene

FAST_CASES = 15
ALL_CASES = 10_000


def fuzz_records(truth, sandbox, seeds):
    """Damage the records of version 1, or their file."""
    path = write_v1(truth, sandbox / "log")
    messages = frame_messages(truth)
    return fuzz(
        lambda store: ingest_scene("waymo", path.parent, SEGMENT, store),
        lambda rng: (path, damaged_record_file(messages, rng)),
        seeds,
        sandbox=sandbox,
        named=(str(path.parent),),
    )


def fuzz_components(truth, sandbox, seeds):
    """Damage one component of version 2."""
    folder = write_v2(truth, sandbox / "log", rows_per_group=5)
    return fuzz(
        lambda store: ingest_scene("waymo", folder, SEGMENT, store),
        lambda rng: damaged_component(folder, rng),
        seeds,
        sandbox=sandbox,
        named=(str(folder),),
    )


def test_damaged_records_are_refused_or_read(tiny_truth, tmp_path):
    outcomes = fuzz_records(tiny_truth, tmp_path, range(FAST_CASES))
    assert outcomes["refused"] > FAST_CASES / 3


def test_damaged_components_are_refused_or_read(tiny_truth, tmp_path):
    outcomes = fuzz_components(tiny_truth, tmp_path, range(FAST_CASES))
    assert outcomes["refused"] > 1


@pytest.mark.slow
@pytest.mark.parametrize("damaged", [fuzz_records, fuzz_components])
def test_ten_thousand_damaged_segments(tiny_truth, tmp_path, record_property, damaged):
    outcomes = damaged(tiny_truth, tmp_path, range(ALL_CASES))
    record_property("outcomes", dict(outcomes))
    assert outcomes["refused"] + outcomes["accepted"] == ALL_CASES
    assert peak_bytes() < MAX_MEMORY_BYTES
