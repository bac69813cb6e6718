"""What is looked for in a recording stands in a run and its report."""

import html
import json
from pathlib import Path


def test_the_report_says_what_was_found_about_the_recording(tiny_run):
    examined = Path(tiny_run.result["artefacts"]["examine"]) / "findings.json"
    findings = json.loads(examined.read_text("utf-8"))
    assert {"camera faults", "exposure", "cameras in their place"} <= {f["name"] for f in findings}
    wrong = [f"{f['name']}: {f['detail']}." for f in findings if f["verdict"] != "ok"]
    assert tiny_run.result["suspicions"] == wrong
    page = html.unescape(Path(tiny_run.result["report"]).read_text("utf-8"))
    assert all(said in page for said in wrong)
