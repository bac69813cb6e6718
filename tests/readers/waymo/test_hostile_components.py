"""A bad Parquet file of Waymo gets one clear line with file, row and column."""

import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from parquet_footers import understate
from waymo_edits import refused_line, with_value
from waymo_numbers import SEGMENT

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.waymo import parquet_rows
from lidarpainter_models.readers.waymo.parquet_rows import ParquetRows
from lidarpainter_models.readers.waymo.range_images import shaped_matrix


def component_refusal(components, store, component, change):
    path = components.root / component / f"{SEGMENT}.parquet"
    pq.write_table(change(pq.read_table(path)), path)
    return refused_line(components, store, f"{component}/{SEGMENT}.parquet")


def test_component_that_is_missing(components, tmp_path):
    path = components.root / "lidar_box" / f"{SEGMENT}.parquet"
    path.unlink()
    line = refused_line(components, tmp_path / "store", str(path))
    assert line.endswith("the file is missing")


def test_column_that_is_missing(components, tmp_path):
    name = "[LiDARComponent].range_image_return1.shape"
    line = component_refusal(
        components, tmp_path / "store", "lidar", lambda table: table.drop_columns([name])
    )
    assert line.endswith(f"no column {name}")


def test_rows_that_are_not_in_the_order_of_time(components, tmp_path):
    line = component_refusal(
        components, tmp_path / "store", "lidar", lambda table: table.take(pa.array([0, 2, 1, 3]))
    )
    assert "row 2, key.frame_timestamp_micros: not in the order of time" in line


@pytest.mark.parametrize(
    ("component", "column", "value", "complaint"),
    [
        ("camera_image", "key.segment_context_name", "other", "row 1, key.segment_context_name"),
        ("camera_image", "[CameraImageComponent].image", None, "row 1, .*image: is empty"),
        ("camera_image", "key.camera_name", 99, "sensor 99 is not known"),
        ("lidar", "[LiDARComponent].range_image_return1.shape", [9, 9, 9], "expected at most"),
        ("vehicle_pose", "key.frame_timestamp_micros", -5, "expected a time since the epoch"),
        ("lidar_box", "key.laser_object_id", "../../x", "actor name"),
        ("lidar_calibration", "[LiDARCalibrationComponent].beam_inclination.min", 9.0, "ascend|90"),
    ],
)
def test_senseless_value(components, tmp_path, component, column, value, complaint):
    change = with_value(column, 1 if component != "vehicle_pose" else 0, value)
    line = component_refusal(components, tmp_path / "store", component, change)
    assert re.search(complaint, line), line


@pytest.mark.parametrize("size", [float("nan"), float("inf")])
@pytest.mark.parametrize("axis", range(3))
def test_shape_that_is_no_number(size, axis):
    shape = [1.0, 1.0, 4.0]
    values = np.zeros(4, np.float32)
    assert shaped_matrix(values, shape, 4, "here").shape == (1, 1, 4)
    shape[axis] = size
    with pytest.raises(DataError, match=r"here: shape .* expected at most"):
        shaped_matrix(values, shape, 4, "here")


REPEATED = {
    "text": (pa.string(), "x" * 10_000, "a text of 10000 bytes, expected 256 at most"),
    "file": (pa.binary(), b"x" * 10_000, "column x is binary, expected numbers or texts"),
    "numbers": (pa.list_(pa.float64()), [0.0] * 1000, "1000 rows of 8000008 bytes, expected at"),
}


@pytest.mark.parametrize("kind", REPEATED)
def test_value_that_all_rows_repeat_is_refused_before_it_is_unpacked(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(parquet_rows, "MAX_SMALL_BYTES", 1 << 20)
    column, value, complaint = REPEATED[kind]
    path = tmp_path / "x.parquet"
    pq.write_table(pa.table({"x": pa.array([value] * 1000, column)}), path)
    assert path.stat().st_size < 10_000
    pool, usual = pa.proxy_memory_pool(pa.default_memory_pool()), pa.default_memory_pool()
    pa.set_memory_pool(pool)
    try:
        with pytest.raises(DataError, match=complaint):
            ParquetRows(path, ("x",)).small_table()
    finally:
        pa.set_memory_pool(usual)
    assert pool.max_memory() < 2 << 20


def test_list_of_one_file_again_and_again_is_refused_before_it_is_unpacked(tmp_path):
    path = tmp_path / "x.parquet"
    kind = pa.list_(pa.binary())
    pq.write_table(pa.table({"x": pa.array([[bytes(1 << 20)] * 100], kind)}), path)
    assert path.stat().st_size < 100_000
    with pytest.raises(DataError, match=r"column x is list<.*>, expected numbers, texts or files"):
        list(ParquetRows(path, ("x",)).stream())


@pytest.mark.parametrize("read", [ParquetRows.small_table, lambda rows: list(rows.stream())])
def test_page_of_more_than_the_footer_says_is_refused_before_it_is_unpacked(
    tmp_path, monkeypatch, read
):
    monkeypatch.setattr(parquet_rows, "MAX_SMALL_BYTES", 1 << 20)
    monkeypatch.setattr(parquet_rows, "MAX_ROW_BYTES", 1 << 20)
    path = tmp_path / "x.parquet"
    pq.write_table(pa.table({"x": ["x" * (4 << 20)]}), path, compression="zstd")
    understate(path)
    assert path.stat().st_size < 10_000
    pool, usual = pa.proxy_memory_pool(pa.default_memory_pool()), pa.default_memory_pool()
    pa.set_memory_pool(pool)
    try:
        with pytest.raises(DataError, match=r"rows of \d{7} bytes, expected"):
            read(ParquetRows(path, ("x",)))
    finally:
        pa.set_memory_pool(usual)
    assert pool.max_memory() < 1 << 20


def test_file_that_is_no_parquet(components, tmp_path):
    path = components.root / "lidar" / f"{SEGMENT}.parquet"
    path.write_bytes(path.read_bytes()[:-3])
    line = refused_line(components, tmp_path / "store", str(path))
    assert "cannot be read as Parquet" in line


def test_frame_of_countless_rows(components, tmp_path):
    line = component_refusal(
        components,
        tmp_path / "store",
        "camera_image",
        lambda table: table.take(pa.array([0] * 100 + [1, 2, 3])),
    )
    assert "row 64: one row too many, expected 64 a frame at most" in line
