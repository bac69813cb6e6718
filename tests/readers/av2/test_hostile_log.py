"""A bad Argoverse 2 log gets one clear line with its file, and leaves nothing behind."""

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pytest
from av2_log import LOG, write_table

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.source_logs.feather_tables import read_feather
from lidarpainter_models.readers.source_logs.folder import SourceFolder

POSES, BOXES = "city_SE3_egovehicle.feather", "annotations.feather"
LENSES, MOUNTS = "calibration/intrinsics.feather", "calibration/egovehicle_SE3_sensor.feather"
SWEEP = "sensors/lidar/*.feather"


def edit(log, pattern, column, value):
    """Write a table anew with another column, without it (None), or with another first value."""
    file = sorted((log.root / LOG).glob(pattern))[0]
    columns = pa.feather.read_table(file).to_pydict()
    if value is None:
        del columns[column]
    elif isinstance(value, list):
        columns[column] = value * len(columns[column])
    else:
        columns[column][0] = value
    write_table(file, columns)


@pytest.mark.parametrize(
    ("pattern", "column", "value", "expected"),
    [
        (POSES, "qw", 7.0, "row 0: a rotation of length"),
        (POSES, "timestamp_ns", None, "no column timestamp_ns or several"),
        (POSES, "timestamp_ns", ["soon"], "timestamp_ns: is string, expected whole numbers"),
        (POSES, "timestamp_ns", [5], "no pose in city_SE3_egovehicle.feather within 0.1 s"),
        (BOXES, "track_uuid", "../../x", "name '../../x' cannot be used"),
        (BOXES, "category", "line\nbreak", "the category is 'line"),
        (LENSES, "fx_px", 0.0, "positive focal lengths"),
        (LENSES, "width_px", 97, "the image is 96 x 54 px, expected 97 x 54"),
        (LENSES, "sensor_name", "other", " is in no calibration"),
        (MOUNTS, "sensor_name", ["other"], "no row of up_lidar"),
        (MOUNTS, "tx_m", 1000.0, "the sensor is 1000"),
        (SWEEP, "laser_number", 64, "a laser 64, expected 0 to 63"),
        (SWEEP, "offset_ns", 10**12, "a point is 1e+03 s from its sweep"),
        (SWEEP, "x", 5000.0, " m from its LiDAR, expected 1000 m at most"),
    ],
)
def test_senseless_value(log, tmp_path, pattern, column, value, expected):
    edit(log, pattern, column, value)
    assert expected in log.refusal(tmp_path / "store")


def test_log_without_sweeps(log, tmp_path):
    for file in (log.root / LOG).glob(SWEEP):
        file.unlink()
    assert "no sweep, expected TIME.feather" in log.refusal(tmp_path / "store")


def feather(tmp_path, content):
    (tmp_path / "t.feather").write_bytes(content)
    return read_feather(SourceFolder(tmp_path), "t.feather", {"x": "number"})


@pytest.mark.parametrize("compression", ["uncompressed", "lz4", "zstd"])
def test_columns_are_read_however_they_are_packed(tmp_path, compression):
    values = np.arange(10_000.0)
    columns = {"name": ["a"] * 10_000, "x": values}
    write_table(tmp_path / "t.feather", columns, compression=compression, chunksize=3000)
    found = read_feather(SourceFolder(tmp_path), "t.feather", {"x": "number", "name": "text"})
    assert np.array_equal(found["x"], values)
    assert found["name"].tolist() == columns["name"]


def test_small_file_that_unpacks_to_gigabytes_is_refused_before_it_is_unpacked(tmp_path):
    file = tmp_path / "t.feather"
    write_table(file, {"x": np.zeros(1 << 16), "y": np.zeros(1 << 16)}, compression="zstd")
    stated = (8 << 16).to_bytes(8, "little", signed=True)
    content = file.read_bytes()
    assert content.count(stated) >= 2
    bomb = content.replace(stated, (1 << 40).to_bytes(8, "little"))
    with pytest.raises(DataError, match=r"bytes when unpacked, expected \d+ at most"):
        feather(tmp_path, bomb)


@pytest.mark.parametrize(
    "content", [b"", b"ARROW1", b"ARROW1" + b"\0" * 60 + b"ARROW1", b"FEA1" * 9]
)
def test_what_is_no_feather_file(tmp_path, content):
    with pytest.raises(DataError, match="not a Feather file of version 2"):
        feather(tmp_path, content)


def test_every_byte_of_the_footer_may_be_wrong(tmp_path):
    write_table(tmp_path / "t.feather", {"x": np.arange(50.0)}, compression="zstd")
    sound, rng = (tmp_path / "t.feather").read_bytes(), np.random.default_rng(0)
    lines = []
    for place in range(8, len(sound), 3):
        damaged = bytearray(sound)
        damaged[place] ^= 1 << int(rng.integers(8))
        try:
            feather(tmp_path, bytes(damaged))
        except DataError as error:
            lines.append(str(error))
    assert len(lines) > 50
    assert not any("\n" in line for line in lines)
