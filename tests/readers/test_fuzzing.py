"""Damaged logs of every dataset are refused with one line or become sound scenes."""

import gzip
from datetime import date
from functools import cache

import pytest
from fuzzing import fuzz
from mutations import Damage, damaged_bytes, damaged_json
from waymo_edits import records_in
from waymo_records import tfrecord
from written_logs import WRITERS

NUM_FAST, NUM_NIGHT = 8, 250
END_BYTES = 1024
# Python's own unpickling of texts warns of what a damaged one holds
pytestmark = pytest.mark.filterwarnings("ignore:invalid escape sequence:DeprecationWarning")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Every log is written once for all tests."""
    return cache(lambda name: WRITERS[name](tmp_path_factory.mktemp("log")))


@pytest.fixture(params=WRITERS)
def log(request, written, tmp_path):
    return written(request.param).copied(tmp_path / "log")


def damaged(content, name, rng):
    """A damaged file: JSON values, what is below a gzip or a checksum, a list, or plain bytes."""
    if name.endswith(".json"):
        return damaged_json(content, rng)
    if name.endswith(".gz") and rng.random() < 0.7:
        inside = damaged_bytes(gzip.decompress(content), rng)
        return Damage(gzip.compress(inside.content, 1), f"unzipped, {inside.description}")
    if name.endswith(".itar") and rng.random() < 0.7:  # images are most of it, its list is last
        end = damaged_bytes(content[-END_BYTES:], rng)
        return Damage(content[:-END_BYTES] + end.content, f"its end, {end.description}")
    if name.endswith(".tfrecord") and rng.random() < 0.7:
        records = records_in(content)
        index = int(rng.integers(len(records)))
        inside = damaged_bytes(records[index], rng)
        records[index] = inside.content
        return Damage(tfrecord(records), f"record {index}, {inside.description}")
    return damaged_bytes(content, rng)


def fuzzed(log, sandbox, seeds):
    """Damage any file of a log, of which every kind is as likely."""
    kinds = {}
    for file in log.files():
        kinds.setdefault(file.suffix, []).append(file)

    def damage(rng):
        files = kinds[sorted(kinds)[rng.integers(len(kinds))]]
        file = files[rng.integers(len(files))]
        return file, damaged(file.read_bytes(), file.name, rng)

    return fuzz(log.ingest, damage, seeds, sandbox=sandbox, named=(str(log.root), log.sequence))


def test_damaged_log_is_refused_or_sound(log, tmp_path):
    outcomes = fuzzed(log, tmp_path, range(NUM_FAST))
    assert outcomes.total() == NUM_FAST
    assert outcomes["refused"] > 0


@pytest.mark.slow
def test_damaged_logs_of_the_day(log, tmp_path):
    """Others every day, so that a month of nights tries 7,500; a failure tells its seed."""
    first = NUM_NIGHT * date.today().toordinal()
    outcomes = fuzzed(log, tmp_path, range(first, first + NUM_NIGHT))
    assert outcomes["refused"] + outcomes["accepted"] == NUM_NIGHT
