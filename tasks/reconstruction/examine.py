"""Look for what is wrong about a recording, once for each scene, so that the report can say it."""

import json
from dataclasses import asdict
from functools import partial
from typing import Any

from catalog.artefacts import Workplace
from lidarpainter_models.scenes.driving_scene import DrivingScene
from tasks.ingest.data_checks import findings_about
from tasks.opened import opened
from tasks.progress import Progress
from tasks.specs import RunSpec
from tasks.stages import StageResult, run_stage, stage_task

STAGE = "examine"
FILE = "findings.json"


@stage_task
def examine(run: RunSpec) -> StageResult:
    """Put everything that the doctor says of a scene into an artefact."""
    this = opened(run)
    return run_stage(
        this.store,
        stage=STAGE,
        kind="findings",
        inputs={"scene": this.scene.content_digest},
        config={},
        build=partial(_build, scene=this.scene),
    )


def suspicions(examined: StageResult) -> list[str]:
    """Return what does not look sound, in sentences."""
    return list(examined.summary["suspicions"])


def _build(place: Workplace, progress: Progress, *, scene: DrivingScene) -> dict[str, Any]:
    progress(0, 1, "clocks, cameras, boxes, exposure, own body")
    findings = findings_about(scene, progress)
    rows = [asdict(finding) for finding in findings]
    (place.output / FILE).write_text(json.dumps(rows, indent=2) + "\n", "utf-8")
    said = [f"{one.name}: {one.detail}." for one in findings if one.verdict != "ok"]
    return {"num_findings": len(findings), "suspicions": said}
