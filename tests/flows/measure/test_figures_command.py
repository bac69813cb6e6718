"""`lidarpainter figures` makes what a table lacks, once, and leaves what it cannot fill."""

import json
from dataclasses import replace

import pytest
from commands import call, refuse, succeed
from toy_store import SMALL, TOY_SCENE, write_toy_scene

from catalog.points import Point
from catalog.store import open_store
from flows.measure.figure_manifest import Cell, read_figure_manifest
from flows.measure.publication import judge
from flows.measure.tables import marked_tables, read_record, rendered

MANIFEST = f"""
pages = ["page.md"]
record = "figures.json"

[[fleet]]
name = "toy"
publish = ["scores"]
set = {json.dumps([*SMALL, "rounds=1"])}
source = [{{ dataset = "stored", scenes = ["{TOY_SCENE}"] }}]
configuration = [{{ name = "painted" }}, {{ name = "unpainted", painter = "none" }}]

[[fleet]]
name = "elsewhere"
missing = "with ours.sh"
source = [{{ dataset = "stored", scenes = ["pandaset/002"] }}]

[[table]]
name = "whole"
fleet = "toy"
figures = ["recorded_psnr"]
row = [{{ label = "held out" }}]
column = [
  {{ label = "first fit", configuration = "painted", variant = "unpainted" }},
  {{ label = "painted", configuration = "painted" }},
  {{ label = "at view time", configuration = "painted", variant = "view-time" }},
  {{ label = "unpainted", configuration = "unpainted" }},
]

[[table]]
name = "lacking"
figures = ["recorded_psnr"]
row = [{{ label = "held out" }}]
column = [
  {{ label = "toy", fleet = "toy", configuration = "painted" }},
  {{ label = "elsewhere", fleet = "elsewhere" }},
]
"""
PAGE = """one
<!-- figures: whole -->
<!-- /figures -->
two
<!-- figures: lacking -->
an old table
<!-- /figures -->
"""


TOY_COLUMN = """  { label = "toy", fleet = "toy", configuration = "painted" },
"""


def write_manifest(folder, text=MANIFEST):
    (folder / "page.md").write_text(PAGE)
    path = folder / "figures.toml"
    path.write_text(text)
    return path


def test_what_cannot_be_made_is_left_and_named(tmp_path):
    path = write_manifest(tmp_path, MANIFEST.replace(TOY_COLUMN, ""))
    store = open_store(tmp_path / "store")
    answer = call("figures", path, "--only", "lacking", "--json", store=store)
    assert answer.code == 2
    left = answer.json["tables"]["lacking"]
    assert left["state"] == "left as it was"
    assert left["reason"].startswith(f"no scene pandaset/002 in {store.name}")
    assert left["reason"].endswith("; with ours.sh")
    assert (tmp_path / "page.md").read_text() == PAGE
    assert read_record(tmp_path / "figures.json") == {}


def test_a_table_that_is_not_there_is_refused(tmp_path):
    words = ("figures", write_manifest(tmp_path), "--only", "wohle", "--store", tmp_path / "store")
    assert "no table wohle, there is whole, lacking" in refuse(*words)


@pytest.mark.slow  # workers import everything anew
def test_runs_are_made_judged_and_shown_once(tmp_path):
    write_toy_scene(tmp_path / "store")
    store, path = open_store(tmp_path / "store"), write_manifest(tmp_path)
    first = call("figures", path, "--json", store=store)
    assert first.code == 2  # of the table that lacks a scene
    assert {name: one["state"] for name, one in first.json["tables"].items()} == {
        "whole": "written",
        "lacking": "left as it was",
    }
    assert "2 of 2 points are to be made" in first.err
    assert "judged by paper, painted at view time" in first.err

    manifest, text = read_figure_manifest(path), (tmp_path / "page.md").read_text()
    record = read_record(tmp_path / "figures.json")
    assert set(record) == {"whole"}
    shown = marked_tables(text, "page")
    assert shown["whole"] == rendered(manifest, manifest.table[0], record["whole"])
    assert shown["lacking"] == "an old table"
    psnr = {
        (row["run_id"], row["variant"]): row["value"]
        for row in store.tables.rows("metrics")
        if (row["protocol"], row["name"]) == ("recorded", "psnr")
    }
    runs = {row["run_id"]: row for row in store.tables.rows("runs")}
    for way, figure, variant in (
        ("painted", "unpainted", "unpainted"),
        ("painted", "final", "painted"),
        ("painted", "view-time", "view-time"),
        ("unpainted", "final", "refined"),
    ):
        entry = record["whole"][f"toy {way} {TOY_SCENE} seed 0"]
        shown_psnr = entry["figures"][f"{figure} recorded_psnr"]
        assert shown_psnr == pytest.approx(psnr[entry["run"], variant], rel=1e-7)
        assert runs[entry["run"]]["source_digest"].startswith(entry["code"])

    files = [tmp_path / "page.md", tmp_path / "figures.json"]
    before = [one.stat().st_mtime_ns for one in files]
    again = succeed("figures", path, "--only", "whole", store=store)
    assert [one.stat().st_mtime_ns for one in files] == before
    assert len(store.tables.rows("runs")) == 2
    assert "to be made" not in again.err
    assert "judged" not in again.err


@pytest.mark.slow
def test_strips_that_other_code_judged_are_judged_again(own_run):
    store, name, figure = own_run.store, "one", "cross-camera/side/psnr"
    point = Point(
        scene=own_run.result["scene"],
        configuration="way",
        seed=0,
        run_id=own_run.run_id,
        cost={},
        metrics={},
    )
    cell = Cell(table="table", fleet="fleet", points=(name,), variant="final", figures=(figure,))
    said = []

    def strips():
        rows = store.tables.rows("metrics")
        return {row["metric_id"]: row for row in rows if row["protocol"] == "cross-camera"}

    def judged(metrics):
        known = replace(point, metrics=metrics)
        assert judge(store, {name: known}, [cell], weights={}, say=said.append)
        return strips()

    first = judged({})
    assert any(row["value"] for row in first.values())
    store.tables.merge("metrics", [{**row, "value": 1.0} for row in first.values()])
    assert judged({("cross-camera", "side", "psnr"): 1.0}) == first
    assert said == [f"{name}: judged by cross-camera"] * 2
