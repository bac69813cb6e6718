"""Tables merge on their id, whoever writes and how often."""

import shutil
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pytest
from deltalake import DeltaTable, write_deltalake

from catalog.errors import StorageError, UnknownRecordError
from catalog.tables import MOST_FILES, CatalogTables

ROOT = Path(__file__).resolve().parents[2]
READER = """
import sys
from catalog.tables import CatalogTables
assert len(CatalogTables(sys.argv[1]).rows("metrics")) == 40
"""


@pytest.fixture
def tables(tmp_path):
    return CatalogTables(str(tmp_path / "tables"))


def test_merging_twice_changes_nothing(tables):
    row = {"run_id": "a", "scene_id": "synthetic/street-0001", "artefacts": ["fit/1"]}
    tables.merge("runs", [row])
    before = tables.rows("runs")
    tables.merge("runs", [row])
    assert tables.rows("runs") == before
    assert len(before) == 1


def test_a_row_with_a_known_id_is_replaced_and_others_stay(tables):
    tables.merge("runs", [{"run_id": "a", "status": "running"}, {"run_id": "b"}])
    tables.merge("runs", [{"run_id": "a", "status": "complete"}])
    assert [(row["run_id"], row["status"]) for row in tables.rows("runs")] == [
        ("a", "complete"),
        ("b", None),
    ]


def test_a_table_never_written_is_empty(tables):
    assert tables.rows("scenes") == []
    tables.merge("scenes", [])
    assert tables.rows("scenes") == []


def test_descriptions_are_stored_with_the_columns(tables):
    tables.merge("scenes", [{"scene_id": "a/b"}])
    field = tables.arrow("scenes").schema.field("duration_s")
    assert field.metadata[b"unit"] == b"s"


def test_a_unique_prefix_finds_a_row(tables):
    tables.merge("runs", [{"run_id": "abc"}, {"run_id": "abd"}, {"run_id": "ab"}])
    assert tables.row("runs", "abc")["run_id"] == "abc"
    assert tables.row("runs", "ab")["run_id"] == "ab"
    with pytest.raises(UnknownRecordError, match="not unique"):
        tables.row("runs", "a")
    with pytest.raises(UnknownRecordError, match="no run_id 'x' among 3 runs"):
        tables.row("runs", "x")


def test_unknown_columns_and_repeated_ids_are_refused(tables):
    with pytest.raises(ValueError, match="no column colour"):
        tables.merge("runs", [{"run_id": "a", "colour": "red"}])
    with pytest.raises(ValueError, match="share a run_id"):
        tables.merge("runs", [{"run_id": "a"}, {"run_id": "a"}])
    assert tables.rows("runs") == []


def test_a_table_of_older_software_gets_the_new_columns(tables):
    old = pa.table({"painter_id": ["a"], "name": ["nano"]})
    write_deltalake(f"{tables.root}/painters", old)
    assert tables.row("painters", "a")["num_bytes"] is None
    tables.merge("painters", [{"painter_id": "b", "num_bytes": 5}])
    assert [row["num_bytes"] for row in tables.rows("painters")] == [None, 5]


def test_rows_are_found_by_some_of_their_values_in_whichever_file_they_lie(tables):
    old = pa.table({"painter_id": ["a", "b"], "name": ["nano", "lama"]})
    write_deltalake(f"{tables.root}/painters", old)  # of software that knew no other columns
    assert tables.arrow("painters", where={"record": ["copy"]}).num_rows == 0
    tables.merge("painters", [{"painter_id": "c", "record": "copy"}, {"painter_id": "d"}])
    where = {"painter_id": ["d", "z"], "name": ["nano"], "record": ["copy"]}
    found = tables.arrow("painters", columns=["painter_id", "num_bytes"], where=where)
    assert sorted(found["painter_id"].to_pylist()) == ["a", "c", "d"]
    assert found["num_bytes"].to_pylist() == [None] * 3
    assert tables.arrow("painters", where={"name": []}).num_rows == 0
    assert tables.arrow("runs", where={"run_id": ["a"]}).num_rows == 0


def test_a_process_that_ends_right_after_a_read_ends_well(tables):
    for number in range(40):
        tables.merge("metrics", [{"metric_id": str(number)}])
    readers = [
        subprocess.Popen([sys.executable, "-c", READER, tables.root], cwd=ROOT) for _ in range(6)
    ]
    assert [reader.wait(timeout=60) for reader in readers] == [0] * 6


def test_a_table_that_cannot_be_written_is_a_storage_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    tables = CatalogTables(str(tmp_path / "file"))
    with pytest.raises(StorageError, match="cannot write table"):
        tables.merge("runs", [{"run_id": "a"}])


def test_a_full_disk_is_told_before_a_commit_begins(tables, monkeypatch):
    tables.merge("runs", [{"run_id": "a"}])
    usage = shutil.disk_usage(tables.root)
    with monkeypatch.context() as patched:
        patched.setattr("catalog.tables.shutil.disk_usage", lambda _: usage._replace(free=1 << 20))
        with pytest.raises(StorageError, match=r"cannot write table .*: no space left"):
            tables.merge("runs", [{"run_id": "b"}])
    tables.merge("runs", [{"run_id": "b"}])
    assert [row["run_id"] for row in tables.rows("runs")] == ["a", "b"]


def test_rows_are_added_once_and_replaced_by_newer_ones_alone(tables):
    assert tables.add_absent("sequences", [{"sequence_id": "a", "fence": 3}]) == 1
    assert tables.add_absent("sequences", [{"sequence_id": "a", "fence": 0}]) == 0
    rows = [{"sequence_id": "a", "fence": 3, "state": "done"}, {"sequence_id": "b", "fence": 9}]
    assert tables.replace_older("sequences", rows, "fence") == 0
    rows[0]["fence"] = 4
    assert tables.replace_older("sequences", rows, "fence") == 1
    found = tables.rows("sequences")
    assert [(row["sequence_id"], row["fence"], row["state"]) for row in found] == [("a", 4, "done")]


def test_many_small_files_are_written_together_and_no_row_is_lost(tables):
    for number in range(MOST_FILES + 3):
        tables.merge("metrics", [{"metric_id": f"{number:03}"}])
    assert len(DeltaTable(f"{tables.root}/metrics").file_uris()) < MOST_FILES
    assert len(tables.rows("metrics")) == MOST_FILES + 3
