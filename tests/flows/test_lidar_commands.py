"""Simulated sweeps and painted lines of a run: judged, written; the sensor of its log."""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import succeed
from pyarrow import parquet
from tiny_street import QUICK_LIDAR, SCENE, reconstructed

from flows import lidar, reconstruct
from flows.measure.figures import LANES, qualities

COLUMNS = {"x", "y", "z", "intensity", "ring", "return", "timestamp_ns", "actor"}


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(lidar, "LidarConfig", QUICK_LIDAR)


def test_held_out_sweeps_judge_a_run_and_enter_the_catalog(tiny_run):
    words = ("evaluate", tiny_run.run_id, "--protocol", "lidar")
    result = succeed(*words, "--json", store=tiny_run.store).json
    figures = result["lidar"]["neurad-studio"]
    assert set(figures) == {
        *("median_squared_depth_m2", "intensity_rmse", "ray_drop_accuracy", "chamfer_m2")
    }
    rows = [row for row in tiny_run.store.tables.rows("metrics") if row["protocol"] == "lidar"]
    entered = {(row["trajectory"], row["name"]): row["value"] for row in rows}
    name = "ray_drop_accuracy"
    assert entered["neurad-studio", name] == pytest.approx(figures[name])
    assert "median_error_static_m" in succeed(*words, store=tiny_run.store).out


def test_a_run_judges_its_sweeps_at_once_where_that_is_asked_for(tiny_run, monkeypatch):
    monkeypatch.setattr(reconstruct, "LidarConfig", QUICK_LIDAR)
    result = reconstructed(tiny_run, "--set", "judge_lidar=true", "--json").json
    within = result["lidar"]["own"]["within_10_cm"]
    page = Path(result["report"]).read_text("utf-8")
    assert "Simulated sweeps of main_pandar64 against 3 held-out ones" in page
    assert f"<td>{within:.4g}</td>" in page
    found = {
        (row["protocol"], row["trajectory"], row["name"]): row["value"]
        for row in tiny_run.store.tables.rows("metrics")
        if row["run_id"] == result["run_id"] and row["value"] is not None
    }
    assert qualities(found)["lidar_within"] == pytest.approx(within)


def test_a_run_judges_its_painted_lines_at_once_where_that_is_asked_for(tiny_run):
    result = reconstructed(tiny_run, "--set", "judge_markings=true", "--json").json
    lines = result["markings"]
    assert {"image", "recorded", "left-2m"} <= set(lines)
    page = Path(result["report"]).read_text("utf-8")
    assert "Painted lines" in page
    assert "told by the LiDAR" in page
    found = {
        (row["protocol"], row["trajectory"], row["name"]): row["value"]
        for row in tiny_run.store.tables.rows("metrics")
        if row["run_id"] == result["run_id"] and row["value"] is not None
    }
    assert found["markings", "recorded", "paint_psnr"] == lines["recorded"]["paint_psnr"]
    assert "left-2m" in LANES  # the one lane that a tiny run judges
    entered = {**found, **{("markings", lane, "auc"): 0.5 for lane in LANES}}
    assert qualities(entered)["markings_auc"] == pytest.approx(0.5)


def test_sweeps_of_another_sensor_are_written_beside_the_path(tiny_run, tmp_path):
    words = ("--trajectory", "lateral:1", "--lidar", "vlp-16", "--frames", "1:3")
    where = ("--lidar-format", "npz", "--out", tmp_path / "s", "--json")
    result = succeed("render", tiny_run.run_id, *words, *where, store=tiny_run.store).json
    assert (result["sensor"], result["num_sweeps"]) == ("vlp-16", 2)
    index = json.loads((tmp_path / "s" / "sweeps.json").read_text())
    with np.load(tmp_path / "s" / index["sweeps"][0]["file"]) as found:
        assert set(found.files) == COLUMNS
        assert len(found["x"]) == index["sweeps"][0]["num_points"] > 500
        assert found["ring"].max() <= 15
        elevation = np.degrees(np.arctan2(found["z"], np.hypot(found["x"], found["y"])))
        assert np.abs(elevation).max() < 15.5  # within a sweep the car drives on a little


def test_sweeps_of_the_log_are_exported_as_parquet(tiny_run, tmp_path):
    words = ("export", tiny_run.run_id, "--format", "sweeps", "--frames", "2:3")
    succeed(*words, "--out", tmp_path / "s", store=tiny_run.store)
    index = json.loads((tmp_path / "s" / "sweeps.json").read_text())
    assert index["simulated"] is True
    table = parquet.read_table(tmp_path / "s" / index["sweeps"][0]["file"])
    assert set(table.column_names) == COLUMNS


def test_the_sensor_of_a_log_is_estimated_and_its_file_taken(tiny_run, tmp_path):
    path = tmp_path / "own.json"
    found = succeed("lidar-model", SCENE, "--out", path, "--json", store=tiny_run.store).json
    assert (found["num_beams"], found["steps"], found["tells_lost"]) == (32, 720, True)
    words = ("--trajectory", "recorded", "--lidar", path, "--frames", "1:2")
    where = ("--lidar-format", "pcd.bin", "--out", tmp_path / "s")
    succeed("render", tiny_run.run_id, *words, *where, store=tiny_run.store)
    (written,) = (tmp_path / "s").rglob("*.pcd.bin")
    assert written.stat().st_size % 20 == 0
