"""The page about the tables says what the tables hold."""

from pathlib import Path

import pyarrow as pa
import pytest

from catalog.schemas import ARROW_TYPES, TABLES
from catalog.sql import tables_page

PAGE = Path(__file__).resolve().parents[2] / "docs" / "tables.md"


def test_the_page_is_current():
    written = PAGE.read_text("utf-8")
    assert written == tables_page(), "lidarpainter catalog tables > docs/tables.md"


@pytest.mark.parametrize("table", TABLES.values(), ids=lambda table: table.name)
def test_every_column_is_described_once(table):
    names = [column.name for column in table.columns]
    assert len(set(names)) == len(names)
    assert table.key.endswith("_id")
    for column in table.columns:
        assert column.description
        assert "|" not in column.description + column.unit
        assert column.arrow.type == ARROW_TYPES[column.type]
    assert table.columns[0].type == "text"
    assert isinstance(table.arrow, pa.Schema)
