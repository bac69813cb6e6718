"""Rows out of Parquet files: what is read of a small file and of a larger one."""

import io
from types import SimpleNamespace

import pyarrow as pa
import pytest
from pyarrow import parquet

from catalog import stored_rows
from catalog.stored_rows import read_rows

TABLE = pa.table({"name": ["a", "b", "c"], "value": [1.0, 2.0, 3.0], "other": ["x", "y", "z"]})


class CountingFile(io.FileIO):
    """A file that says how often it was read."""

    reads = 0

    def read(self, size=-1):
        self.reads += 1
        return super().read(size)


@pytest.fixture
def there(tmp_path):
    path = tmp_path / "part.parquet"
    parquet.write_table(TABLE, path)
    file = CountingFile(path)
    fragment = SimpleNamespace(open=lambda: pa.PythonFile(file, mode="r"))
    return SimpleNamespace(schema=TABLE.schema, get_fragments=lambda: [fragment]), file


def test_a_small_file_is_read_at_once(there):
    dataset, file = there
    assert read_rows(dataset, TABLE.schema, {"name": ["b"]}).to_pylist() == [
        {"name": "b", "value": 2.0, "other": "y"}
    ]
    assert file.reads == 1


def test_of_a_larger_file_columns_are_read(there, monkeypatch):
    monkeypatch.setattr(stored_rows, "SMALL_BYTES", 0)
    dataset, file = there
    wanted = pa.schema([TABLE.schema.field("value")])
    assert read_rows(dataset, wanted, {"name": ["b", "c"]}).to_pylist() == [
        {"value": 2.0},
        {"value": 3.0},
    ]
    assert file.reads > 1
