"""A scene is written whole or not at all, by one writer at a time."""

import errno
import fcntl
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from lidarpainter_models.errors import DataError, SceneError, StorageError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes import array_writer, schema
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import (
    BoxRecord,
    Distortion,
    ImageRecord,
    RollingShutter,
    SweepPoints,
)
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter

IDENTITY = torch.eye(4, dtype=torch.float64)
HEADER = SceneHeader(licence="test", global_from_world=IDENTITY)


def some_jpeg(width_px=32, height_px=24, seed=0):
    rng = np.random.default_rng(seed)
    picture = rng.integers(0, 255, (height_px, width_px, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", picture)[1].tobytes()


def some_points(num_points=50, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return SweepPoints(
        xyz_m=torch.randn(num_points, 3, generator=generator) * 10,
        intensity=torch.rand(num_points, generator=generator),
        time_offset_ns=torch.arange(num_points, dtype=torch.int32),
        ring=torch.full((num_points,), -1, dtype=torch.int16),
        return_index=torch.zeros(num_points, dtype=torch.int8),
        lidar=torch.zeros(num_points, dtype=torch.uint8),
    )


def some_record(**changes):
    lens = {"fx_px": 30.0, "fy_px": 30.0, "cx_px": 16.0, "cy_px": 12.0}
    camera = Camera(world_from_camera=IDENTITY, width_px=32, height_px=24, **lens)
    return ImageRecord(**{"camera_name": "front", "timestamp_ns": 5, "camera": camera, **changes})


def some_box(**changes):
    box = {
        "actor_id": "car-1",
        "category": "Car",
        "timestamp_ns": 5,
        "world_from_box": IDENTITY,
        "size_m": (4.0, 2.0, 1.5),
        "is_moving": True,
        "num_points": 3,
    }
    return BoxRecord(**{**box, **changes})


def add_frame(writer, frame_index=0, num_points=50):
    writer.add_frame(frame_index, timestamp_ns=100 * frame_index, world_from_ego=IDENTITY)
    writer.add_image(some_record(), some_jpeg())
    add_sweep(writer, some_points(num_points, seed=frame_index))


def add_sweep(writer, points, **changes):
    writer.add_sweep("roof", points, timestamp_ns=7, **{"world_from_lidar": IDENTITY, **changes})


def files_below(folder):
    return sorted(path for path in Path(folder).rglob("*") if path.is_file())


def test_what_is_written_is_what_is_read(tmp_path):
    with SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
        for frame_index in (3, 4):
            add_frame(writer, frame_index)
            writer.add_box(some_box())
    scene = DrivingScene.open(writer.path)
    assert scene.frame_indices == (3, 4)
    expected = some_points(seed=4)
    points = scene.read_points(4)
    for name in SweepPoints.__dataclass_fields__:
        assert torch.equal(getattr(points, name), getattr(expected, name)), name
    assert scene.read_jpeg(scene.views[1]) == some_jpeg()
    assert scene.tracks[0].size_m.tolist() == [4.0, 2.0, 1.5]
    scene.verify_content()


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


def test_nothing_is_left_when_the_caller_fails(tmp_path):
    def write(writer):
        add_frame(writer)
        raise RuntimeError

    with pytest.raises(RuntimeError), SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
        write(writer)
    assert files_below(tmp_path) == []


@pytest.mark.parametrize("good_writes", [0, 1, 5])
def test_full_disk_is_one_line_and_leaves_nothing(tmp_path, monkeypatch, good_writes):
    written = []
    write_chunk = array_writer.ArrayAppender._flush

    def write_until_full(array, num_rows):
        written.append(num_rows)
        if len(written) > good_writes:
            raise OSError(errno.ENOSPC, "No space left on device")
        write_chunk(array, num_rows)

    monkeypatch.setattr(array_writer.ArrayAppender, "_flush", write_until_full)
    with (
        pytest.raises(StorageError, match=r"cannot be written: No space left.*free") as raised,
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        add_frame(writer)
    assert "\n" not in str(raised.value)
    assert files_below(tmp_path) == []


def add_full_frames(writer, num_frames=3):
    for frame_index in range(num_frames):
        add_frame(writer, frame_index, num_points=schema.ARRAYS["point_xyz_m"].chunk_rows)


def add_frame_with_boxes(writer, boxes):
    add_frame(writer)
    writer.add_boxes(boxes)


def test_error_in_the_thread_that_writes_is_raised_and_leaves_nothing(tmp_path, monkeypatch):
    def refuse(_array, _start, _rows):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(array_writer.ArrayAppender, "_write", refuse)
    with (
        pytest.raises(StorageError, match="cannot be written: No space left"),
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        add_full_frames(writer)
    assert files_below(tmp_path) == []


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


@pytest.mark.parametrize("position", [0, 3])
def test_one_senseless_box_among_many_is_named(tmp_path, position):
    boxes = [some_box(actor_id=f"car-{number}") for number in range(5)]
    boxes[position] = replace(boxes[position], world_from_box=2 * IDENTITY)
    with (
        pytest.raises(DataError, match=f"actor car-{position}: the pose is not a rotation"),
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        add_frame_with_boxes(writer, boxes)


@pytest.mark.parametrize("category", ["", "a\nb", "\ud800", "x" * 201])
def test_category_that_is_no_printable_text_is_refused(tmp_path, category):
    with (
        pytest.raises(DataError, match="expected a printable text"),
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        add_frame_with_boxes(writer, [some_box(category=category)])


def test_full_disk_while_publishing_leaves_the_old_scene(tmp_path, monkeypatch):
    with SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
        add_frame(writer, num_points=20)
    before = DrivingScene.open(writer.path).content_digest

    def refuse(*_args, **_options):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("lidarpainter_models.scenes.writer.pq.write_table", refuse)
    with pytest.raises(StorageError), SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
        add_frame(writer, num_points=30)
    assert DrivingScene.open(writer.path).content_digest == before
    assert [path.name for path in writer.path.parent.iterdir()] == ["a"]


def test_store_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "scenes").write_text("a file in the way")
    with (
        pytest.raises(StorageError, match="cannot be written"),
        SceneWriter(tmp_path, "rig", "a", HEADER),
    ):
        pass


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


def test_what_a_killed_writer_left_is_cleared_away(tmp_path):
    abandoned = tmp_path / "scenes/rig/.a.writing-dead"
    abandoned.mkdir(parents=True)
    (abandoned / ".writing").touch()
    alive = tmp_path / "scenes/rig/.a.writing-live"
    alive.mkdir()
    with (alive / ".writing").open("wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
            add_frame(writer)
        assert not abandoned.exists()
        assert alive.exists()


@pytest.mark.parametrize("name", ["../x", "a/b", "", ".hidden", "a b", "ü", "a\n"])
@pytest.mark.parametrize("position", [0, 1])
def test_name_that_is_no_plain_folder_is_refused(tmp_path, name, position):
    names = ["rig", "a"]
    names[position] = name
    with pytest.raises(DataError, match="cannot be used: expected at most 128 letters"):
        SceneWriter(tmp_path, *names, HEADER)
    assert files_below(tmp_path) == []


@pytest.mark.parametrize("missing", ["frames", "pictures", "points"])
def test_scene_without_frames_pictures_or_points_is_refused(tmp_path, missing):
    def write(writer):
        if missing == "frames":
            return
        writer.add_frame(0, timestamp_ns=0, world_from_ego=IDENTITY)
        if missing == "points":
            writer.add_image(some_record(), some_jpeg())
        else:
            add_sweep(writer, some_points())

    with (
        pytest.raises(DataError, match=f"rig/a: zero {missing}, expected at least one"),
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        write(writer)
    assert files_below(tmp_path) == []


def bad_poses():
    stretched = IDENTITY.clone()
    stretched[0, 0] = 2
    mirrored = IDENTITY.clone()
    mirrored[2, 2] = -1
    return {"nan": IDENTITY * torch.nan, "stretched": stretched, "mirrored": mirrored}


BAD_THINGS = {
    **{
        f"{name} ego pose": lambda writer, pose=pose: writer.add_frame(
            1, timestamp_ns=999, world_from_ego=pose
        )
        for name, pose in bad_poses().items()
    },
    "frame out of order": lambda writer: writer.add_frame(
        0, timestamp_ns=999, world_from_ego=IDENTITY
    ),
    "time out of order": lambda writer: writer.add_frame(
        1, timestamp_ns=0, world_from_ego=IDENTITY
    ),
    "nan lidar pose": lambda writer: add_sweep(
        writer, some_points(), world_from_lidar=IDENTITY * torch.nan
    ),
    "zero points": lambda writer: add_sweep(writer, some_points(0)),
    "nan point": lambda writer: add_sweep(
        writer, SweepPoints(**{**vars(some_points(2)), "xyz_m": torch.full((2, 3), torch.nan)})
    ),
    "absurdly far point": lambda writer: add_sweep(
        writer, SweepPoints(**{**vars(some_points(2)), "xyz_m": torch.full((2, 3), 1e7)})
    ),
    "classes without names": lambda writer: add_sweep(
        writer, some_points(), semantics=torch.zeros(50, dtype=torch.uint8)
    ),
    "flat box": lambda writer: writer.add_box(some_box(size_m=(4.0, 0.0, 1.5))),
    "endless box": lambda writer: writer.add_box(some_box(size_m=(4.0, torch.inf, 1.5))),
    "nan box pose": lambda writer: writer.add_box(some_box(world_from_box=IDENTITY * torch.nan)),
    "picture of another size": lambda writer: writer.add_image(some_record(), some_jpeg(16, 16)),
    "cut-off picture": lambda writer: writer.add_image(some_record(), some_jpeg()[:-60]),
    "no picture": lambda writer: writer.add_image(some_record(), b"GIF89a"),
    "empty picture": lambda writer: writer.add_image(some_record(), b""),
    "camera name with a slash": lambda writer: writer.add_image(
        some_record(camera_name="../front"), some_jpeg()
    ),
}


@pytest.mark.parametrize("thing", BAD_THINGS)
def test_bad_input_is_one_line_with_its_place_and_leaves_nothing(tmp_path, thing):
    def write(writer):
        writer.add_frame(0, timestamp_ns=0, world_from_ego=IDENTITY)
        BAD_THINGS[thing](writer)

    with (
        pytest.raises(DataError) as raised,
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        write(writer)
    assert "\n" not in str(raised.value)
    assert "frame" in str(raised.value) or "name" in str(raised.value)
    assert files_below(tmp_path) == []


def test_same_camera_twice_in_a_frame_is_refused(tmp_path):
    def write(writer):
        add_frame(writer)
        writer.add_image(some_record(), some_jpeg())

    with (
        pytest.raises(DataError, match="frame 0, camera front: given twice"),
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        write(writer)


def test_point_classes_of_another_number_are_refused(tmp_path):
    header = replace(HEADER, semantic_classes={0: "Ground"})

    def write(writer):
        writer.add_frame(0, timestamp_ns=0, world_from_ego=IDENTITY)
        add_sweep(writer, some_points(), semantics=torch.zeros(3, dtype=torch.uint8))

    with (
        pytest.raises(DataError, match="the columns of the points differ in length"),
        SceneWriter(tmp_path, "rig", "a", header) as writer,
    ):
        write(writer)


def test_picture_before_any_frame_is_refused(tmp_path):
    with (
        pytest.raises(SceneError, match="add_frame must come before camera front"),
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        writer.add_image(some_record(), some_jpeg())


@pytest.mark.parametrize(
    ("model", "terms"), [("brown", (-0.3, 0.1, 0.001, -0.002, 0.0)), ("fisheye", (0.1, 0.0, 0, 0))]
)
def test_distorted_picture_comes_back_as_a_pinhole_sees_it(tmp_path, model, terms):
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
    picture = scene.read_image(view)
    assert picture.shape == (24, 32, 3)
    assert view.camera.fx_px != record.camera.fx_px
    # a pixel's grey tells the column it came from: ask OpenCV where a pinhole direction lands
    column, row = 22, 9
    direction = view.camera.pixel_directions()[row, column].numpy().astype(np.float64)
    matrix = np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
    module = cv2 if model == "brown" else cv2.fisheye
    landed, _ = module.projectPoints(
        *(direction.reshape(1, 1, 3), np.zeros(3), np.zeros(3), matrix, np.array(terms))
    )
    assert int(picture[row, column, 0]) == pytest.approx(255 * landed[0, 0, 0] / 31, abs=4)


def test_unknown_distortion_is_refused():
    with pytest.raises(DataError, match="'spherical' is not known, expected one of none, brown"):
        Distortion("spherical", ())
    with pytest.raises(DataError, match="takes 4 terms, got 2"):
        Distortion("fisheye", (0.1, 0.2))
