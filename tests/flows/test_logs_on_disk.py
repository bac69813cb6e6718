"""Logs as downloaded come into the store by the command, and the doctor looks at them."""

import json

import cv2
import pytest
from commands import call, succeed
from written_logs import WRITERS

from catalog.store import open_store


@pytest.fixture
def store(tmp_path):
    return open_store(tmp_path / "store")


@pytest.mark.parametrize("name", WRITERS)
def test_ingest_brings_every_dataset_into_the_store_once(name, store, tmp_path):
    log = WRITERS[name](tmp_path)
    words = ("ingest", log.dataset, log.root, "--json")
    (row,) = succeed(*words, store=store).json["scenes"]
    manifest = store.root / "scenes" / row["scene_id"] / "manifest.json"
    written_ns = manifest.stat().st_mtime_ns
    again = succeed(*words, store=store)
    assert again.json["scenes"] == [row]
    assert manifest.stat().st_mtime_ns == written_ns
    assert again.err == "ingest: was there\n"
    (listed,) = succeed("catalog", "list", "scenes", "--json", store=store).json["rows"]
    assert listed["scene_id"] == row["scene_id"]
    assert listed["num_frames"] == row["num_frames"] > 1
    assert row["scene_id"] in succeed(*words[:-1], store=store).out


def test_ingest_takes_the_frames_and_cameras_asked_for(store, tmp_path):
    log = WRITERS["pandaset"](tmp_path)
    words = ("--frames", "1:3", "--cameras", "back_camera,front_camera", "--json")
    (row,) = succeed("ingest", "pandaset", log.root, log.sequence, *words, store=store).json[
        "scenes"
    ]
    assert (row["num_frames"], row["num_views"]) == (2, 4)
    assert set(row["cameras"]) == {"back_camera", "front_camera"}


def test_one_damaged_sequence_of_two_is_told_and_the_other_is_there(store, tmp_path):
    log = WRITERS["pandaset"](tmp_path)
    log.copied(tmp_path / "other")
    (tmp_path / "other" / log.sequence).rename(log.root / "003")
    (log.root / "003/lidar/timestamps.json").unlink()
    answer = call("ingest", "pandaset", log.root, "--json", store=store)
    assert answer.code == 2
    assert [row["sequence"] for row in answer.json["scenes"]] == [log.sequence]
    assert [failure["sequence"] for failure in answer.json["failures"]] == ["003"]
    complaints = [line for line in answer.err.splitlines() if line.startswith("lidarpainter: ")]
    assert len(complaints) == 1
    assert "timestamps.json" in complaints[0]


def test_doctor_looks_at_a_dataset_a_scene_and_the_setup(store, tmp_path):
    log = WRITERS["pandaset"](tmp_path)
    found = succeed("doctor", "pandaset", log.root, "--json", store=store).json
    assert found["is_fit"]
    assert all(one["name"].startswith(f"{log.sequence}: ") for one in found["findings"])
    overlay = store.root / "doctor/pandaset" / f"{log.sequence}.png"
    assert cv2.imread(str(overlay)).std() > 5
    assert json.loads(overlay.with_suffix(".json").read_text())["is_fit"]
    assert not (store.root / "scenes").exists()  # it was only looked at

    succeed("ingest", "pandaset", log.root, store=store)
    out = tmp_path / "looked-at.png"
    words = ("doctor", f"pandaset/{log.sequence}", "--out", out)
    assert "points in images" in succeed(*words, store=store).out
    assert cv2.imread(str(out)).shape[2] == 3

    setup = succeed("doctor", "--json", store=store).json
    assert setup["is_fit"]
    names = {one["name"] for one in setup["findings"]}
    assert {"python", "torch", "kernels", "device", "store", "painter nano"} <= names
