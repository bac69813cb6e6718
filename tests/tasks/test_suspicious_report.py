"""A report names what the examination of a recording found."""

from dataclasses import replace

from tasks.reconstruction.examine import examine, suspicions
from tasks.reconstruction.report import REPORT_FILE, ReportInputs, write_report
from tasks.specs import FittedRef

SAID = "exposure: front_left_camera is 23% darker than front_camera."


def test_what_was_found_stands_in_the_report(store, parameters, stages, final, run):
    asked = parameters.run_spec(store.root)
    found = examine.fn(asked)
    assert suspicions(found) == found.summary["suspicions"]
    result = {
        "run_id": run.run_id,
        "scene": parameters.scene,
        "preset": "preview",
        "painter": "warp",
        "split": "alternate",
        "rounds": 1,
        "num_gaussians": 1,
        "recorded": None,
        "novel": None,
        "unpainted": None,
        "guidance": {},
    }
    page = ReportInputs(
        result=result,
        source_digest="a" * 16,
        unpainted=FittedRef(stages["prepare"].ref, stages["fit"].ref),
        final=final,
        stages={**stages, "examine": replace(found, summary={"suspicions": [SAID]})},
    )
    report = write_report.fn(asked, page, parameters.evaluation_config)
    text = (store.artefacts.folder(report.ref) / REPORT_FILE).read_text("utf-8")
    assert SAID in text
