"""Tables as they were, tables with fewer files, and tables that older software wrote."""

import time
from datetime import UTC, datetime, timedelta

import pytest
from deltalake import DeltaTable, write_deltalake

from catalog import schemas
from catalog.errors import UnknownRecordError
from catalog.schemas import SCENES, Column, TableSchema
from catalog.table_upkeep import compact, vacuum
from catalog.tables import CatalogTables


def row(number, **values):
    return {"scene_id": f"toy/{number}", "num_frames": 1, **values}


@pytest.fixture
def tables(tmp_path):
    """The table `scenes` of three versions: made, one row, two rows, the first one changed."""
    found = CatalogTables(str(tmp_path / "tables"))
    found.merge("scenes", [row(1)])
    found.merge("scenes", [row(2)])
    found.merge("scenes", [row(1, num_frames=7)])
    return found


def frames(tables, **options):
    return {one["scene_id"]: one["num_frames"] for one in tables.rows("scenes", **options)}


def test_a_table_is_read_as_it_was(tables):
    assert frames(tables, as_of=1) == {"toy/1": 1}
    assert frames(tables, as_of=2) == {"toy/1": 1, "toy/2": 1}
    assert frames(tables, as_of=datetime.now(UTC)) == frames(tables) == {"toy/1": 7, "toy/2": 1}
    then = datetime.now(UTC)
    time.sleep(0.05)  # clocks of file systems tick a few milliseconds apart
    tables.merge("scenes", [row(3)])
    assert frames(tables, as_of=then) == frames(tables, as_of=3) != frames(tables)
    assert tables.rows("runs", as_of=1) == []


@pytest.mark.parametrize("as_of", [9, -1, 10**12])
def test_a_version_that_is_not_there_is_said_so(tables, as_of):
    with pytest.raises(UnknownRecordError, match=f"no scenes as of {as_of}, the last version is 3"):
        tables.rows("scenes", as_of=as_of)


def test_compaction_keeps_rows_and_versions_and_vacuum_keeps_recent_ones(tables):
    before = tables.rows("scenes")
    (done,) = compact(tables)
    assert (done.table, done.files_after) == ("scenes", 1)
    assert done.files_before > 1
    assert tables.rows("scenes") == before
    assert frames(tables, as_of=2) == {"toy/1": 1, "toy/2": 1}
    assert vacuum(tables, timedelta(days=1), dry_run=False) == {"scenes": []}
    listed = vacuum(tables, timedelta(0), dry_run=True)
    assert frames(tables, as_of=2) == {"toy/1": 1, "toy/2": 1}
    removed = vacuum(tables, timedelta(0), dry_run=False)
    assert len(removed["scenes"]) == len(listed["scenes"]) > 0
    assert tables.rows("scenes") == before
    with pytest.raises(UnknownRecordError, match="scenes as of 2 was vacuumed"):
        tables.rows("scenes", as_of=2)


def test_a_store_of_the_version_before_is_read_and_written_on(tmp_path, monkeypatch):
    """Older software knew fewer columns, and one that is no longer there."""
    old = TableSchema(
        "scenes",
        SCENES.description,
        (*SCENES.columns[:6], Column("weather", "text", "a column that was given up")),
    )
    monkeypatch.setitem(schemas.TABLES, "scenes", old)
    tables = CatalogTables(str(tmp_path / "tables"))
    tables.merge("scenes", [row(1, weather="rain"), row(2, weather="fog")])
    monkeypatch.setitem(schemas.TABLES, "scenes", SCENES)
    assert set(tables.rows("scenes")[0]) == set(SCENES.arrow.names)
    assert [one["num_views"] for one in tables.rows("scenes")] == [None, None]
    tables.merge("scenes", [row(2, num_views=5), row(3, num_views=6)])
    assert [one["num_views"] for one in tables.rows("scenes")] == [None, 5, 6]
    assert [one["num_views"] for one in tables.rows("scenes", as_of=1)] == [None, None]
    stored = DeltaTable(f"{tables.root}/scenes").to_pyarrow_table().to_pylist()
    assert {one["scene_id"]: one["weather"] for one in stored} == {
        "toy/1": "rain",
        "toy/2": "fog",
        "toy/3": None,
    }


def test_a_table_that_another_program_filled_is_read(tmp_path):
    """Wider types and other orders of columns are cast, unknown columns left out."""
    tables = CatalogTables(str(tmp_path / "tables"))
    foreign = {"mood": ["good"], "num_frames": [3], "scene_id": ["toy/1"]}
    import pyarrow as pa

    arrow = pa.table(foreign).cast(
        pa.schema([("mood", pa.string()), ("num_frames", pa.int32()), ("scene_id", pa.string())])
    )
    write_deltalake(f"{tables.root}/scenes", arrow)
    assert frames(tables) == {"toy/1": 3}
