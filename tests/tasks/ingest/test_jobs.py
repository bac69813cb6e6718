"""Many sequences: several at once, one failure set aside, what is done not done again."""

import os
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
from toy_store import write_toy_scene

from catalog.store import open_store
from lidarpainter_models.errors import ConfigError, DataError, LidarPainterError
from lidarpainter_models.scenes.stored import stored_digest
from tasks.ingest import jobs as ingest_jobs
from tasks.ingest.jobs import IngestRequest, ingest_or_recall, ingest_sequences
from tasks.ingest.sequences import find_sequences
from tasks.progress import ProgressListener, listening


@pytest.fixture
def request_of(tmp_path):
    """Three sequences, the second of them damaged."""
    source = write_toy_scene(tmp_path / "elsewhere")
    for name in "abc":
        shutil.copytree(source, tmp_path / "root" / name)
    os.truncate(tmp_path / "root/b/frames.parquet", 10)
    return IngestRequest(tmp_path / "store", "canonical", tmp_path / "root")


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_one_failing_sequence_does_not_stop_the_others(request_of, jobs):
    told = []
    done = ingest_sequences(request_of, ["a", "b", "c"], jobs=jobs, on_failure=told.append)
    assert len(done.rows) == 2
    assert [failure["sequence"] for failure in done.failures] == ["b"]
    assert len(told) == 1
    assert "b/frames.parquet" in told[0]


def test_only_sequence_that_fails_is_an_error(request_of):
    with pytest.raises(LidarPainterError, match=r"b/frames\.parquet"):
        ingest_sequences(request_of, ["b"], on_failure=print)


def count_reads(monkeypatch):
    read = []
    ingest = ingest_jobs.ingest_sequence.fn

    def counted(*arguments):
        read.append(arguments[3])
        return ingest(*arguments)

    monkeypatch.setattr(ingest_jobs.ingest_sequence, "fn", counted)
    return read


def test_what_is_done_is_not_done_again(request_of, monkeypatch):
    read = count_reads(monkeypatch)
    first = ingest_or_recall(request_of, "a", False)
    assert ingest_or_recall(request_of, "a", False) == first
    assert read == ["a"]
    assert ingest_or_recall(request_of, "a", True) == first
    assert read == ["a", "a"]


def test_who_waited_for_another_reader_reads_nothing(request_of, monkeypatch):
    read, begun, waits = count_reads(monkeypatch), threading.Event(), threading.Event()
    counted = ingest_jobs.ingest_sequence.fn

    class Waiter(ProgressListener):
        def waiting(self, _stage, _holder):
            waits.set()

    def slow(*arguments):
        begun.set()
        waits.wait(10)
        return counted(*arguments)

    def second():
        with listening(Waiter()):
            return ingest_or_recall(request_of, "a", False)

    monkeypatch.setattr(ingest_jobs.ingest_sequence, "fn", slow)
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(ingest_or_recall, request_of, "a", False)
        assert begun.wait(10)
        assert pool.submit(second).result() == first.result()
    assert read == ["a"]


def test_a_scene_that_is_gone_is_read_anew(request_of, monkeypatch):
    read = count_reads(monkeypatch)
    row = ingest_or_recall(request_of, "a", False)
    shutil.rmtree(open_store(request_of.store_path).scene_folder(row["scene_id"]))
    ingest_or_recall(request_of, "a", False)
    assert read == ["a"] * 2


@pytest.mark.parametrize(
    ("first", "then", "expected"),
    [
        ({}, {"cameras": ("front",)}, None),  # all there are, in other words
        ({"cameras": ("front",)}, {}, "with cameras front, asked for: all cameras; it was kept"),
        ({}, {"frames": slice(0, 1)}, "with all frames, asked for: frames 0:1; it was kept"),
        ({"frames": slice(None, 2)}, {"frames": slice(0, 2)}, None),
        ({"frames": slice(0, 2)}, {"frames": slice(1, 3)}, "with frames 0:2, asked for: frames 1:"),
    ],
)
def test_another_choice_of_a_stored_scene_is_refused(
    request_of, monkeypatch, first, then, expected
):
    read = count_reads(monkeypatch)
    row = ingest_or_recall(replace(request_of, **first), "a", False)
    if expected is None:
        assert ingest_or_recall(replace(request_of, **then), "a", False) == row
        assert read == ["a"]
        return
    with pytest.raises(ConfigError, match=f"scene toy/street is in the store {expected}"):
        ingest_or_recall(replace(request_of, **then), "a", False)
    folder = open_store(request_of.store_path).scene_folder("toy/street")
    assert stored_digest(folder) == row["content_digest"]
    ingest_or_recall(replace(request_of, **then), "a", True)
    assert read == ["a", "a"]


def test_the_same_sequence_of_another_root_is_refused(request_of, tmp_path):
    ingest_or_recall(request_of, "a", False)
    shutil.copytree(request_of.root, tmp_path / "other")
    with pytest.raises(ConfigError, match=r"root .*/root, asked for: root .*/other"):
        ingest_or_recall(replace(request_of, root=tmp_path / "other"), "a", False)


def test_cameras_are_compared_where_nothing_is_noted(request_of):
    row = ingest_or_recall(request_of, "a", False)
    scene = open_store(request_of.store_path).root / "scenes"
    (scene / "canonical").mkdir()
    shutil.copytree(scene / "toy/street", scene / "canonical/c")  # as if read by other software
    with pytest.raises(ConfigError, match="with cameras front, asked for: cameras back; it was"):
        ingest_or_recall(replace(request_of, cameras=("back",)), "c", False)
    assert ingest_or_recall(request_of, "c", False) == row


@pytest.mark.parametrize("named", [(), ("lidar",)])
def test_a_part_of_a_dataset_is_no_root(tmp_path, named):
    for place in ("002/lidar", "103/lidar"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "poses.json").write_text("[]")
    with pytest.raises(DataError, match=f"use its parent {tmp_path}, which holds 002, 103"):
        find_sequences("pandaset", tmp_path / "002", named)
    assert find_sequences("pandaset", tmp_path) == ["002", "103"]
    assert find_sequences("pandaset", tmp_path, ("103", "7", "103")) == ["103", "7"]
