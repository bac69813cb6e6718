"""A run and its report say what is wrong about the recording, and how far it can be trusted."""

import html
import json
from dataclasses import asdict, replace
from pathlib import Path

from tiny_street import FRONT, NUM_FRAMES

from flows.views import viewed_run
from lidarpainter_models.evaluation.view_confidence import BUNDLED
from lidarpainter_models.export.view_requests import ViewRequest
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from tasks.runs import open_run


def test_the_report_says_what_was_found_about_the_recording(tiny_run):
    examined = Path(tiny_run.result["artefacts"]["examine"]) / "findings.json"
    findings = json.loads(examined.read_text("utf-8"))
    assert {"camera faults", "exposure", "cameras in their place"} <= {f["name"] for f in findings}
    wrong = [f"{f['name']}: {f['detail']}." for f in findings if f["verdict"] != "ok"]
    assert tiny_run.result["suspicions"] == wrong
    page = html.unescape(Path(tiny_run.result["report"]).read_text("utf-8"))
    assert all(said in page for said in wrong)


def test_demo_says_how_far_each_stretch_can_be_trusted(tiny_run):
    found = tiny_run.result["envelope"]
    assert found["cameras"] == [FRONT]
    assert (found["good_db"], found["promised"]) == (25.0, 0.9)
    (stretch,) = found["stretches"]
    assert (stretch["first_frame"], stretch["last_frame"]) == (0, NUM_FRAMES - 1)
    assert 0 <= stretch["recorded_confidence"] <= 1
    assert found["held_out"]["num_frames"] == NUM_FRAMES // 2  # of one camera
    assert "anchored on 3 held-out frames" in found["calibration"]["record"]
    rows = [row for row in tiny_run.rows["metrics"] if row["protocol"] == "envelope"]
    told = {row["trajectory"]: row["value"] for row in rows}
    assert told == {
        "left": stretch["left_m"],
        "right": stretch["right_m"],
        "up": stretch["up_m"],
        "ahead": stretch["ahead_m"],
        "yaw-left": stretch["yaw_left_deg"],
        "yaw-right": stretch["yaw_right_deg"],
    }
    assert all((row["value"] is None) == bool(row["reason"]) for row in rows)
    page = Path(tiny_run.result["report"]).read_text("utf-8")
    assert "Where it can be trusted" in page


def test_delivered_frames_are_trusted_as_their_run_says(tiny_run):
    store = tiny_run.store
    request = ViewRequest(trajectory=parse_trajectory("recorded"))
    finished = open_run(store, tiny_run.result["run_id"])
    viewed = viewed_run(store, finished, request)
    assert asdict(viewed.calibration) == tiny_run.result["envelope"]["calibration"]
    unjudged = replace(finished, result=finished.result | {"envelope": None})
    assert viewed_run(store, unjudged, request).calibration == BUNDLED.anchored(())
