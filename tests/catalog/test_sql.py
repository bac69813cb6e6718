"""Whoever asks the catalog gets rows or one line, and reaches nothing but its tables."""

import datetime
from pathlib import Path

import pytest

import catalog.sql
from catalog.errors import CatalogError, StorageError
from catalog.schemas import TABLES
from catalog.sql import CatalogSql
from catalog.tables import CatalogTables


def two_runs(folder):
    tables = CatalogTables(str(folder / "a store [1]*'é" / "tables"))
    tables.merge("runs", [{"run_id": "a", "scene_id": "x/1"}, {"run_id": "b", "seconds": 2.0}])
    return tables


@pytest.fixture
def tables(tmp_path):
    return two_runs(tmp_path)


@pytest.fixture(scope="module")
def sql(tmp_path_factory):
    return CatalogSql(two_runs(tmp_path_factory.mktemp("sql")))


def test_a_question_is_answered_from_the_tables_as_they_were_when_it_began(tables):
    sql = CatalogSql(tables)
    tables.merge("runs", [{"run_id": "c"}])
    answer = sql.ask("SELECT run_id, seconds FROM runs WHERE run_id > $id", {"id": "a"})
    assert (answer.columns, answer.rows) == (
        ("run_id", "seconds"),
        [{"run_id": "b", "seconds": 2.0}],
    )
    assert len(CatalogSql(tables).ask("FROM runs").rows) == 3


def test_every_table_has_its_columns_also_before_anything_was_written(sql):
    for name, schema in TABLES.items():
        assert sql.ask(f"FROM {name}").columns == tuple(schema.arrow.names)


def test_columns_that_an_older_store_lacks_are_null(tables, monkeypatch):
    from dataclasses import replace

    runs = TABLES["runs"]
    older = CatalogTables(tables.root + "-older")
    with monkeypatch.context() as patch:
        patch.setitem(TABLES, "runs", replace(runs, columns=runs.columns[:3]))
        older.merge("runs", [{"run_id": "a"}])
    row = CatalogSql(older).ask("FROM runs").rows[0]
    assert tuple(row) == tuple(runs.arrow.names)
    assert row["artefacts"] is row["started_at"] is None


def test_times_are_in_utc(tables):
    now = datetime.datetime(2026, 1, 2, 3, tzinfo=datetime.UTC)
    tables.merge("runs", [{"run_id": "t", "started_at": now}])
    text = "SELECT started_at, started_at::VARCHAR AS said FROM runs WHERE run_id = 't'"
    (row,) = CatalogSql(tables).ask(text).rows
    assert row == {"started_at": now, "said": "2026-01-02 03:00:00+00"}


def test_rows_beyond_the_limit_are_cut_off_and_that_is_said(sql):
    answer = sql.ask("FROM range(1000000000000)", most_rows=3)
    assert (len(answer.rows), answer.is_cut) == (3, True)
    assert not sql.ask("FROM range(3)", most_rows=3).is_cut


@pytest.mark.parametrize(
    "text",
    [
        "",
        "SELECT '",
        "SELECT 1; SELECT 2",
        "SELECT nothing FROM runs",
        "SELECT * FROM runs WHERE seconds > 'long'",
        "DROP VIEW runs",
        "INSERT INTO runs VALUES (1)",
        "CREATE TABLE mine AS SELECT 1",
        "ATTACH 'other.db'",
        "COPY runs TO 'rows.csv'",
        "EXPORT DATABASE 'all'",
        "SET memory_limit = '99GB'",
        "SET enable_external_access = true",
        "INSTALL httpfs",
        "LOAD httpfs",
        "PRAGMA database_list",
        "SELECT * FROM read_csv('/etc/passwd')",
        "SELECT * FROM read_text('/etc/passwd')",
        "SELECT * FROM '/etc/passwd'",
        "SELECT * FROM glob('/*')",
        "SELECT * FROM read_parquet('https://example.org/a.parquet')",
        "SELECT * FROM query('COPY runs TO ''rows.csv''')",
        "SELECT error('one\ntwo')",
        "SELECT * FROM tables",  # a name of this module's Python
    ],
)
def test_what_is_no_question_about_the_tables_gets_one_line(sql, text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = sorted(Path.cwd().iterdir())
    with pytest.raises(CatalogError) as raised:
        sql.ask(text)
    assert "\n" not in str(raised.value)
    assert sorted(Path.cwd().iterdir()) == before
    assert len(sql.ask("FROM runs").rows) == 2


def test_a_question_ends_in_time(sql, monkeypatch):
    monkeypatch.setattr(catalog.sql, "LONGEST_S", 0.2)
    with pytest.raises(CatalogError, match="took more than"):
        sql.ask("SELECT sum(a.range) FROM range(1000000) a, range(1000000) b")


def test_a_question_keeps_to_its_memory(tables, monkeypatch):
    monkeypatch.setitem(catalog.sql._BOUNDS, "memory_limit", "32MB")
    with pytest.raises(CatalogError, match="of memory"):
        CatalogSql(tables).ask("SELECT list(range) FROM range(100000000)")


def test_a_damaged_table_is_one_line(tables):
    (file,) = tables.files("runs")
    Path(file).write_bytes(b"no parquet")
    with pytest.raises(StorageError, match="runs: it is damaged"):
        CatalogSql(tables)
