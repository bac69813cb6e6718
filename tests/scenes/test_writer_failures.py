"""A scene is written whole or not at all, whatever fails meanwhile."""

import errno
import fcntl

import pytest
from scene_parts import HEADER, add_frame, files_below

from lidarpainter_models.errors import WriteError
from lidarpainter_models.scenes import array_writer, schema
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.writer import SceneWriter


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
        pytest.raises(WriteError, match=r"cannot be written: No space left.*free") as raised,
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        add_frame(writer)
    assert "\n" not in str(raised.value)
    assert files_below(tmp_path) == []


def add_full_frames(writer, num_frames=3):
    for frame_index in range(num_frames):
        add_frame(writer, frame_index, num_points=schema.ARRAYS["point_xyz_m"].chunk_rows)


def test_error_in_the_thread_that_writes_is_raised_and_leaves_nothing(tmp_path, monkeypatch):
    def refuse(_array, _start, _rows):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(array_writer.ArrayAppender, "_write", refuse)
    with (
        pytest.raises(WriteError, match="cannot be written: No space left"),
        SceneWriter(tmp_path, "rig", "a", HEADER) as writer,
    ):
        add_full_frames(writer)
    assert files_below(tmp_path) == []


def test_full_disk_while_publishing_leaves_the_old_scene(tmp_path, monkeypatch):
    with SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
        add_frame(writer, num_points=20)
    before = DrivingScene.open(writer.path).content_digest

    def refuse(*_args, **_options):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("lidarpainter_models.scenes.stored.pq.write_table", refuse)
    with pytest.raises(WriteError), SceneWriter(tmp_path, "rig", "a", HEADER) as writer:
        add_frame(writer, num_points=30)
    assert DrivingScene.open(writer.path).content_digest == before
    assert [path.name for path in writer.path.parent.iterdir()] == ["a"]


def test_store_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "scenes").write_text("a file in the way")
    with (
        pytest.raises(WriteError, match="cannot be written"),
        SceneWriter(tmp_path, "rig", "a", HEADER),
    ):
        pass


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
