"""Many sequences: several at once, one failure set aside, what is done not done again."""

import os
import shutil

import pytest
from toy_store import write_toy_scene

from catalog.store import open_store
from lidarpainter_models.errors import LidarPainterError
from tasks.ingest import jobs as ingest_jobs
from tasks.ingest.jobs import IngestRequest, ingest_or_recall, ingest_sequences


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


def test_another_request_or_a_scene_that_is_gone_is_read_anew(request_of, monkeypatch):
    read = count_reads(monkeypatch)
    row = ingest_or_recall(request_of, "a", False)
    fewer = IngestRequest(
        request_of.store_path, request_of.dataset, request_of.root, frames=slice(0, 1)
    )
    ingest_or_recall(fewer, "a", False)
    ingest_or_recall(request_of, "a", False)
    shutil.rmtree(open_store(request_of.store_path).scene_folder(row["scene_id"]))
    ingest_or_recall(request_of, "a", False)
    assert read == ["a"] * 4
