"""A stage is computed once, catalogued, measured, and never stale."""

import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from catalog.code_closure import SourceTree
from catalog.errors import ConflictError, StorageError
from catalog.store import open_store
from lidarpainter_models.errors import DataError
from tasks import stages
from tasks.measuring import measured
from tasks.progress import listener, listening

ROOT = Path(__file__).parents[2]
MEASURES = """
from tasks.measuring import measured

with measured() as small:
    pass
with measured() as large:
    block = bytearray(200_000_000)
    block[::4096] = b"1" * len(block[::4096])
assert large.peak_memory_bytes > small.peak_memory_bytes + 150_000_000, (small, large)
assert large.seconds > 0
assert large.cpu_seconds > 0
"""


class Heard:
    def __init__(self):
        self.events = []

    def started(self, stage):
        self.events.append(("started", stage))

    def advanced(self, stage, done, total, note):
        self.events.append(("advanced", stage, done, total, note))

    def waiting(self, stage, process_id):
        self.events.append(("waiting", stage, process_id))

    def finished(self, stage, _seconds, *, is_new):
        self.events.append(("finished", stage, is_new))


def write_number(place, progress):
    (place.output / "number.txt").write_text("7")
    progress(1, 2)
    return {"num_gaussians": 3}


@pytest.fixture(autouse=True)
def _code_of_these_tests(monkeypatch):
    """Let the builds below count as code of the project."""
    tree = SourceTree({__name__.partition(".")[0]: Path(__file__).parents[1]})
    monkeypatch.setattr(stages, "project_source", lambda: tree)


def run(store, build=write_number, **changes):
    values = {"stage": "fit", "kind": "gaussians", "inputs": {"a": "b"}, "config": {"steps": 1}}
    return stages.run_stage(store, **{**values, **changes}, build=build)


def test_a_stage_is_computed_once_and_entered_into_the_catalog(tmp_path):
    store = open_store(tmp_path)
    first = run(store)
    second = run(store)
    assert (first.is_new, second.is_new) == (True, False)
    assert first.summary["num_gaussians"] == second.summary["num_gaussians"] == 3
    assert first.peak_memory_bytes > 1e7
    assert first.seconds == second.seconds
    row = store.tables.row("artefacts", first.ref.artefact_id)
    assert row["config"] == '{"steps":1}'


def test_a_row_that_was_not_written_is_written_by_who_comes_next(tmp_path, monkeypatch):
    store = open_store(tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(store.tables, "merge", lambda *_: fail_to_write())
        with pytest.raises(StorageError, match="full"):
            run(store)
    again = run(store)
    assert not again.is_new
    assert store.tables.find("artefacts", again.ref.artefact_id) is not None


def fail_to_write():
    raise StorageError("full")


def test_changed_code_is_never_served_a_stale_result(tmp_path, monkeypatch):
    source = tmp_path / "stage_code.py"
    source.write_text("def build(place, progress):\n    return {'version': 1}\n")
    monkeypatch.syspath_prepend(tmp_path)
    build = import_module("stage_code").build
    store, found = open_store(tmp_path / "store"), []
    for text in ("# 1\n", "# two\n", "VERSION = 2\n", source.read_text().replace("1", "2")):
        source.write_text(source.read_text() + text)
        tree = SourceTree({"stage_code": tmp_path / "stage_code"})
        monkeypatch.setattr(stages, "project_source", lambda tree=tree: tree)
        found.append(run(store, build=build).is_new)
    assert found == [True, False, False, True]


def test_who_listens_hears_a_stage_from_start_to_end(tmp_path):
    heard = Heard()
    with listening(heard):
        run(open_store(tmp_path))
        run(open_store(tmp_path))
    assert heard.events == [
        ("started", "fit"),
        ("advanced", "fit", 1, 2, ""),
        ("finished", "fit", True),
        ("started", "fit"),
        ("finished", "fit", False),
    ]
    listener().started("fit")  # and afterwards nobody does
    assert len(heard.events) == 5


def fail(place, _progress):
    (place.output / "half.txt").write_text("1")
    raise DataError("no such image")


def test_a_failing_stage_leaves_no_artefact_and_no_row(tmp_path):
    store = open_store(tmp_path)
    with pytest.raises(DataError, match="no such image"):
        run(store, build=fail)
    assert store.tables.rows("artefacts") == []
    assert list((tmp_path / "aside").iterdir()) == []


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (ConflictError("busy"), True),
        (ConnectionError("reset"), True),
        (DataError("bad"), False),
        (StorageError("full"), False),
        (RuntimeError("bug"), False),
    ],
)
def test_only_what_may_pass_by_itself_is_tried_again(error, expected):
    class State:
        def result(self, raise_on_failure):
            assert not raise_on_failure
            return error

    assert stages.is_worth_retrying(None, None, State()) is expected


def test_a_measurement_sees_time_and_memory():
    """In a process of its own: where a peak cannot be reset, all that ran before is in it."""
    subprocess.run([sys.executable, "-c", MEASURES], cwd=ROOT, check=True)


def test_compiling_a_kernel_is_not_counted_as_work():
    began_s = time.process_time()
    with measured() as cost:
        assert njit(lambda values: values.sum() + 1.0)(np.ones(8)) == 9
    assert cost.cpu_seconds < 0.5 * (time.process_time() - began_s)
