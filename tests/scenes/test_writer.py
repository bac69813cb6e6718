"""What is written comes back, whole, from one writer at a time."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scene_parts import (
    HEADER,
    IDENTITY,
    add_frame,
    add_sweep,
    some_box,
    some_jpeg,
    some_points,
    some_record,
)

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes import array_writer, schema
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import Distortion, RollingShutter, SweepPoints
from lidarpainter_models.scenes.writer import SceneWriter


def test_what_is_written_is_what_is_read(tmp_path):
    with SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
        for frame_index in (3, 4):
            add_frame(writer, frame_index)
            writer.add_box(some_box(timestamp_ns=100 * frame_index))
    scene = DrivingScene.open(writer.path)
    assert scene.frame_indices == (3, 4)
    expected = some_points(seed=4)
    points = scene.read_points(4)
    for name in SweepPoints.__dataclass_fields__:
        assert torch.equal(getattr(points, name), getattr(expected, name)), name
    assert scene.read_jpeg(scene.views[1]) == some_jpeg()
    assert scene.tracks[0].size_m.tolist() == [4.0, 2.0, 1.5]
    scene.verify_content()


_OTHER_KINDS = """
import sys
from pathlib import Path
import numpy as np
from scene_parts import HEADER, IDENTITY, add_sweep, some_box, some_jpeg, some_points, some_record
from lidarpainter_models.scenes.records import Distortion
from lidarpainter_models.scenes.writer import SceneWriter

lens = Distortion("brown", (0, np.float32(0.25), 0, 0))
with SceneWriter(Path(sys.argv[1]), "rig", "a", HEADER) as writer:
    writer.add_frame(np.int64(3), timestamp_ns=np.int64(0), world_from_ego=IDENTITY)
    writer.add_image(some_record(timestamp_ns=np.int64(5), distortion=lens), some_jpeg())
    add_sweep(writer, some_points())
    size_m, yes = (4, np.float32(2), 1.5), np.bool_(True)
    count = eval(sys.argv[2])
    writer.add_box(some_box(size_m=size_m, is_moving=yes, num_points=count))
"""


def _written_by_a_user(store, count):
    """A scene of ints among floats and of numpy's numbers; tests themselves check all types."""
    path = os.pathsep.join(["tests/support", *sys.path])
    return subprocess.run(
        [sys.executable, "-c", _OTHER_KINDS, store, count],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )


def test_numbers_of_other_kinds_are_stored_as_the_format_says(tmp_path):
    told = _written_by_a_user(tmp_path, "np.int32(3)")
    assert told.returncode == 0, told.stderr
    folder = tmp_path / "scenes/rig/a"
    DrivingScene.open(folder).verify_content()
    again = DrivingScene.open(ingest_scene("canonical", folder, "a", tmp_path / "store"))
    assert again.tracks[0].size_m.tolist() == [4.0, 2.0, 1.5]
    assert again.tracks[0].num_points.tolist() == [3]


def test_a_value_of_another_kind_is_refused_in_one_line(tmp_path):
    told = _written_by_a_user(tmp_path, "'many'")
    last = told.stderr.strip().splitlines()[-1]
    assert "DataError: rig/a: the table of boxes holds a value of another kind" in last
    assert not (tmp_path / "scenes/rig/a").exists()


def test_rows_that_fill_many_chunks_keep_their_order(tmp_path):
    layout = schema.ArrayLayout("rows", np.dtype("int16"), (2,), 7, "1", "counted")
    with ThreadPoolExecutor(1) as writing:
        arrays = array_writer.create_arrays(tmp_path / "a.zarr", [layout], writing)
        expected = np.arange(100).reshape(50, 2).astype(np.int16)
        offsets = [arrays["rows"].append(part) for part in np.split(expected, [0, 1, 8, 29, 30])]
        entry = arrays["rows"].finish()
    assert offsets == [0, 0, 1, 8, 29, 30]
    assert entry["shape"] == [50, 2]
    group = array_writer.zarr.open_group(tmp_path / "a.zarr", mode="r")
    np.testing.assert_array_equal(group["rows"][:], expected)


def test_many_boxes_at_once_are_those_given_one_by_one(tmp_path):
    boxes = [some_box(actor_id=f"car-{number}") for number in range(5)]
    digests = []
    for name, adds in (("a", [boxes]), ("b", [[box] for box in boxes])):
        with SceneWriter(tmp_path / name, "rig", "a", HEADER) as writer:
            add_frame(writer)
            for some in adds:
                writer.add_boxes(some)
        digests.append(DrivingScene.open(writer.path).content_digest)
    assert digests[0] == digests[1]


def test_second_writing_replaces_the_first_whole(tmp_path):
    for num_points in (20, 30):
        with SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
            add_frame(writer, num_points=num_points)
    assert DrivingScene.open(writer.path).sweeps[0].num_points == 30
    assert [path.name for path in writer.path.parent.iterdir()] == ["a"]


def test_equal_scene_is_left_alone_for_those_who_read_it(tmp_path):
    inodes = set()
    for _ in range(2):
        with SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
            add_frame(writer)
        inodes.add(writer.path.stat().st_ino)
    assert len(inodes) == 1
    assert [path.name for path in writer.path.parent.iterdir()] == ["a"]


def test_two_writers_at_once_do_not_meet(tmp_path):
    with SceneWriter(tmp_path, "rig", "a", HEADER) as slow:
        add_frame(slow, num_points=20)
        with SceneWriter(tmp_path, "rig", "a", HEADER) as quick:
            add_frame(quick, num_points=30)
        assert DrivingScene.open(quick.path).sweeps[0].num_points == 30
    assert DrivingScene.open(slow.path).sweeps[0].num_points == 20


def _driving_at_10_mps(store, rolling_shutter):
    """Three images 100 ms apart of a camera that drives 1 m along its z from each to the next."""
    with SceneWriter(store, "rig", "a", HEADER) as writer:
        for frame in range(3):
            pose = IDENTITY.clone()
            pose[2, 3] = frame
            camera = replace(some_record().camera, world_from_camera=pose)
            time_ns = 100_000_000 * frame
            writer.add_frame(frame, timestamp_ns=time_ns, world_from_ego=IDENTITY)
            record = {"timestamp_ns": time_ns, "camera": camera, "rolling_shutter": rolling_shutter}
            writer.add_image(some_record(**record), some_jpeg())
    return DrivingScene.open(writer.path)


def test_a_view_has_the_time_and_place_of_its_middle_row(tmp_path):
    told = RollingShutter(duration_s=0.04, direction="down", first_row_s=-0.03)
    scene = _driving_at_10_mps(tmp_path, told)
    view = scene.views[1]
    assert view.timestamp_ns == 90_000_000
    assert view.camera.centre_world.tolist() == pytest.approx([0.0, 0.0, 0.9])
    assert view.camera.shutter.across_s == (0.0, 0.04)
    stated = scene.image_record(view)
    assert (stated.timestamp_ns, stated.rolling_shutter) == (100_000_000, told)
    assert stated.camera.centre_world.tolist() == [0.0, 0.0, 1.0]


def test_a_readout_of_which_no_first_row_is_told_is_centred(tmp_path):
    view = _driving_at_10_mps(tmp_path, RollingShutter(duration_s=0.04, direction="up")).views[1]
    assert view.timestamp_ns == 100_000_000
    assert view.camera.centre_world.tolist() == [0.0, 0.0, 1.0]
    assert view.camera.shutter.across_s == (0.0, -0.04)


def test_a_first_row_read_at_no_possible_time_is_refused(tmp_path):
    late = RollingShutter(duration_s=0.04, direction="down", first_row_s=11.0)
    with pytest.raises(DataError, match="first row is read 11"):
        _driving_at_10_mps(tmp_path, late)


@pytest.mark.parametrize(
    ("model", "terms"), [("brown", (-0.3, 0.1, 0.001, -0.002, 0.0)), ("fisheye", (0.1, 0.0, 0, 0))]
)
def test_distorted_image_comes_back_as_a_pinhole_sees_it(tmp_path, model, terms):
    record = some_record(
        distortion=Distortion(model, terms),
        rolling_shutter=RollingShutter(duration_s=0.02, direction="down"),
    )
    ramp = np.repeat(np.linspace(0, 255, 32, dtype=np.uint8)[None, :, None], 24, axis=0)
    jpeg = cv2.imencode(".jpg", np.repeat(ramp, 3, axis=2))[1].tobytes()
    with SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
        writer.add_frame(0, timestamp_ns=0, world_from_ego=IDENTITY)
        writer.add_image(record, jpeg)
        add_sweep(writer, some_points())
    scene = DrivingScene.open(writer.path)
    view = scene.views[0]
    image = scene.read_image(view)
    assert image.shape == (24, 32, 3)
    assert view.camera.fx_px != record.camera.fx_px
    # a pixel's grey tells the column it came from: ask OpenCV where a pinhole direction lands
    column, row = 22, 9
    direction = view.camera.pixel_directions()[row, column].numpy().astype(np.float64)
    matrix = np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
    module = cv2 if model == "brown" else cv2.fisheye
    landed, _ = module.projectPoints(
        *(direction.reshape(1, 1, 3), np.zeros(3), np.zeros(3), matrix, np.array(terms))
    )
    assert int(image[row, column, 0]) == pytest.approx(255 * landed[0, 0, 0] / 31, abs=4)
