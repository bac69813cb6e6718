"""The size of Parquet files is taken from their pages, whatever their footers say."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from parquet_footers import STATED_BYTES, understate

from lidarpainter_models.readers.source_logs.parquet_pages import unpacked_bytes

WAYS = {
    "as usual": {},
    "second version": {"data_page_version": "2.0"},
    "plain": {"use_dictionary": False, "compression": "none"},
    "with checksums and an index": {"write_page_checksum": True, "write_page_index": True},
    "many pages and groups": {"data_page_size": 1000, "row_group_size": 777},
    "differences": {"use_dictionary": False, "column_encoding": {"n": "DELTA_BINARY_PACKED"}},
}


def written(path, **options):
    rng = np.random.default_rng(0)
    lists = [rng.normal(size=count) for count in rng.integers(0, 9, 3000)]
    columns = {"n": rng.integers(0, 5, 3000), "list": lists, "text": list("abc") * 1000}
    pq.write_table(pa.table(columns), path, **options)
    return pq.read_metadata(path), sum(map(len, lists))


@pytest.mark.parametrize("way", WAYS)
def test_pages_are_found_however_they_are_written(tmp_path, way):
    footer, in_lists = written(tmp_path / "x.parquet", **WAYS[way])
    found = unpacked_bytes(tmp_path / "x.parquet", footer)
    assert len(found) == footer.num_row_groups
    assert 8 * (6000 + in_lists) <= sum(found) < 3 * 8 * (6000 + in_lists)


@pytest.mark.parametrize("place", ["data_page_offset", "in the middle"])
def test_header_that_is_none_is_refused(tmp_path, place):
    path = tmp_path / "x.parquet"
    footer, _ = written(path)
    column = footer.row_group(0).column(1)
    start = min(column.data_page_offset, column.dictionary_page_offset)
    content = bytearray(path.read_bytes())
    content[start + (place == "in the middle")] = 0xFF
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"page|number"):
        unpacked_bytes(path, footer)


def test_file_that_ends_before_its_pages_do_is_refused(tmp_path):
    footer, _ = written(tmp_path / "x.parquet")
    (tmp_path / "short.parquet").write_bytes((tmp_path / "x.parquet").read_bytes()[:500])
    with pytest.raises(ValueError, match="outside of the file"):
        unpacked_bytes(tmp_path / "short.parquet", footer)


def test_footer_that_says_little_is_not_believed(tmp_path):
    path = tmp_path / "x.parquet"
    table = pa.table({"x": pa.array([bytes(4 << 20)], pa.binary())})
    pq.write_table(table, path, compression="zstd", use_dictionary=False)
    understate(path)
    footer = pq.read_metadata(path)
    assert footer.row_group(0).total_byte_size == STATED_BYTES
    (found,) = unpacked_bytes(path, footer)
    assert 4 << 20 < found < (4 << 20) + 100
