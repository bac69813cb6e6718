"""The table of formats is what there is: every writer is found, every format is described."""

import re
from pathlib import Path

import pytest

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.export.formats import FORMAT_NAMES, FORMATS, export_format, formats_help

DOCS = Path(__file__).parents[2] / "docs" / "exports.md"


@pytest.mark.parametrize("row", FORMATS, ids=FORMAT_NAMES)
def test_a_format_is_found_and_loads_its_writer(row):
    assert export_format(row.name) is row
    is_written_view_by_view = row.kind in ("views", "page", "sweeps", "simulated")
    assert (row.writer == "") == is_written_view_by_view
    assert not row.writer or callable(row.load_writer())
    reader = row.load_reader()
    assert reader is None or callable(reader)
    assert row.is_moving <= (row.kind == "scene")
    assert f"{row.name}: " in formats_help()


def test_the_docs_describe_these_formats_and_no_others():
    rows = re.findall(r"^\| (`[a-z].*?) \|", DOCS.read_text("utf-8"), re.MULTILINE)
    described = {name for row in rows for name in re.findall(r"`([a-z-]+)`", row)}
    assert described == set(FORMAT_NAMES)


def test_an_unknown_format_is_refused_by_those_that_there_are():
    with pytest.raises(ConfigError, match="--format 'obj': expected one of ply, spz, gltf"):
        export_format("obj")
