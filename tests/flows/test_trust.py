"""A run and its report say what is wrong about the recording, and how far it can be trusted."""

import html
import json
from pathlib import Path

from tiny_street import FRONT, NUM_FRAMES


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
