"""Points of messages, whatever their fields are called, count and begin with."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.bags.clouds import points_of, time_field_of
from lidarpainter_models.readers.bags.frame_tree import FrameTree
from lidarpainter_models.readers.bags.messages import BagTransform

HEADER_NS = 1_700_000_000_123_456_789
TURN_S = np.array([0.0, 0.04, 0.1])
ROS_TYPES = {"u2": 4, "u4": 6, "i4": 5, "f4": 7, "f8": 8, "i1": 1}


def cloud(columns, *, order="<", padding=0, height=1, **changes):
    """A PointCloud2 of columns by name: (type, values)."""
    kinds = [(name, order + form) for name, (form, _) in columns.items()]
    count = len(next(iter(columns.values()))[1])
    rows = np.zeros(count, np.dtype(kinds))
    for name, (_, values) in columns.items():
        rows[name] = values
    fields = [
        SimpleNamespace(name=name, offset=rows.dtype.fields[name][1], datatype=ROS_TYPES[form])
        for name, (form, _) in columns.items()
    ]
    width, step = count // height, rows.dtype.itemsize
    data = b"".join(
        rows[row * width : (row + 1) * width].tobytes() + b"\xff" * padding for row in range(height)
    )
    message = {
        "fields": fields,
        "point_step": step,
        "row_step": width * step + padding,
        "width": width,
        "height": height,
        "is_bigendian": order == ">",
        "data": data,
    }
    return SimpleNamespace(**{**message, **changes})


def xyz(count=3):
    return {axis: ("f4", np.arange(1.0, count + 1) + n) for n, axis in enumerate("xyz")}


@pytest.mark.parametrize(
    ("name", "form", "values"),
    [
        ("t", "u4", TURN_S * 1e9),
        ("offset_time", "u4", TURN_S * 1e9),
        ("time", "f4", TURN_S),
        ("time", "f4", TURN_S - 0.1),
        ("timestamp", "f8", HEADER_NS / 1e9 + TURN_S),
        ("timestamp", "f8", TURN_S * 1e6),
        ("t", "i4", TURN_S * 1e3),
    ],
)
def test_times_of_points_count_from_the_header_or_the_epoch_in_any_unit(name, form, values):
    message = cloud({**xyz(), name: (form, values)})
    assert time_field_of(message, "test") == name
    points = points_of(message, HEADER_NS, "test", time_field=name)
    begins_s = -0.1 if values[0] < 0 else 0.0
    assert np.abs(points.offset_ns - (TURN_S + begins_s) * 1e9).max() < 2000  # of a float64 epoch


@pytest.mark.parametrize("order", ["<", ">"])
def test_fields_come_in_any_order_and_rows_may_be_padded(order):
    columns = {"ring": ("u2", [1, 2, 3, 4]), "z": ("f8", [1.0, 2, 3, 4])}
    columns |= {"intensity": ("f4", [9, 8, 7, 6]), **{k: xyz(4)[k] for k in "yx"}}
    points = points_of(cloud(columns, order=order, padding=5, height=2), 0, "t", time_field=None)
    assert points.xyz_m.tolist() == [[n, n + 1.0, n] for n in (1.0, 2, 3, 4)]
    assert points.ring.tolist() == [1, 2, 3, 4]
    assert points.intensity.tolist() == [9, 8, 7, 6]
    assert points.offset_ns.tolist() == [0, 0, 0, 0]


def test_points_of_no_return_are_left_out():
    columns = {axis: ("f4", [1.0, np.nan, 0.0, np.inf]) for axis in "xyz"}
    points = points_of(cloud(columns), 0, "test", time_field=None)
    assert points.xyz_m.tolist() == [[1.0, 1.0, 1.0]]


@pytest.mark.parametrize(
    ("columns", "changes", "expected"),
    [
        ({"x": ("f4", [1.0])}, {}, "no field y, z, expected it among x"),
        (xyz(), {"width": 4}, "states 4 points of 12 bytes, holds 36 bytes"),
        (xyz(), {"width": 2**62}, "states 4611686018427387904 points"),
        (xyz(), {"point_step": 8}, "points of 8 bytes with fields up to 12"),
        (xyz(), {"point_step": 0}, "points of 0 bytes"),
        (xyz(), {"fields": []}, "points of 12 bytes with fields up to 0"),
        (xyz(), {"fields": [SimpleNamespace(name="x", offset=0, datatype=9)]}, "is of type 9"),
        ({**xyz(), "t": ("f8", [0.0, 5e9, 1e10])}, {}, "are no turn of a LiDAR"),
        ({**xyz(), "t": ("f8", [0.0, np.nan, 1.0])}, {}, "a time is not finite"),
        ({**xyz(), "t": ("f8", [1e6, 1e6, 1e6 + 0.1])}, {}, "is 1e+06 s from its message"),
    ],
)
def test_clouds_that_make_no_sense(columns, changes, expected):
    time = "t" if "t" in columns else None
    with pytest.raises(DataError) as raised:
        points_of(cloud(columns, **changes), HEADER_NS, "test", time_field=time)
    assert expected in str(raised.value)


def transform(parent, child, time_ns=0, x_m=0.0):
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = x_m
    return BagTransform(parent=parent, child=child, time_ns=time_ns, parent_from_child=pose)


def test_frames_are_tied_through_the_root_and_move_between_poses():
    drive = [transform("map", "car", n * 10**8, x_m=n * 1.0) for n in range(3)]
    tree = FrameTree([*drive, transform("car", "roof", x_m=0.5), transform("car", "eye")], "bag")
    times_ns = np.array([5 * 10**7])
    assert tree.poses("map", "roof", times_ns)[0, 0, 3] == pytest.approx(1.0)
    assert tree.poses("eye", "roof", times_ns)[0, 0, 3] == pytest.approx(0.5)
    assert tree.span_ns("map", "car") == (0, 2 * 10**8)
    assert tree.span_ns("car", "roof") is None
    assert tree.frames == ("car", "eye", "map", "roof")


@pytest.mark.parametrize(
    ("transforms", "expected"),
    [
        ([transform("a", "b"), transform("c", "b")], "'b' stands in 'a' and in 'c'"),
        ([transform("a", "b"), transform("b", "a")], "stands in itself"),
        ([transform("x", "b")], "nothing ties frame 'b' to 'a'"),
    ],
)
def test_trees_that_are_none(transforms, expected):
    with pytest.raises(DataError) as raised:
        FrameTree(transforms, "bag").poses("a", "b", np.zeros(1, np.int64))
    assert expected in str(raised.value)


def test_gap_in_the_poses_is_told():
    drive = [transform("map", "car", n * 10**8, x_m=float(n)) for n in (0, 1, 40)]
    with pytest.raises(DataError, match=r"no pose of frame 'car' for 3.90 s after 0.100 s"):
        FrameTree(drive, "bag").span_ns("map", "car")
