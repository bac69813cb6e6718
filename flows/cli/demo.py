"""`lidarpainter demo`: see the whole pipeline work, without any data."""

import shlex
import shutil
import sys
from pathlib import Path
from typing import Annotated

import typer

from flows.cli.output import print_json, say_status
from flows.cli.shared_options import AsJson, Painter, Settings, check_painter, described

FIRST_IMAGE_NAME = "street.png"
REPORT_NAME = "report.html"
PAGE_NAME = "drive.html"
STORE_NAME = "store"

WORDS = """
out: Folder that the report and the store are written to.
seed: Number from 0 to 999 that decides which street is drawn; painters train on streets of other
  seeds.
"""


@described(WORDS)
def demo(
    out: Path = Path("demo"),
    seed: Annotated[int, typer.Option(min=0, max=999)] = 1,
    painter: Painter = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Run the built-in street through the whole pipeline.

    Into --out come street.png, what the camera saw first, after a minute, and in the end
    report.html, and drive.html, which plays the drive and the lane beside it in any browser.

    Example: lidarpainter demo --out demo
    """
    from flows.environment import keep_prefect_in

    keep_prefect_in(str(out / STORE_NAME))
    from catalog.errors import storage_errors
    from catalog.store import open_store
    from flows.cli.reconstruct import show
    from flows.overrides import with_changes, with_overrides
    from flows.presets import brief
    from tasks.specs import street_id

    parameters = brief(street_id(seed))
    if painter is not None:
        parameters = with_changes(parameters, {"painter": painter})
    parameters = with_overrides(parameters, settings or [])
    say_status(f"drawing the street of seed {seed}")
    check_painter(painter)
    store = open_store(out / STORE_NAME)
    from flows.cli.progress import shown_progress
    from flows.cli.running import run_demo
    from flows.exports import export_run
    from lidarpainter_models.export.view_requests import ViewRequest
    from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
    from lidarpainter_models.geometry.trajectory_words import RECORDED

    result = run_demo(parameters, seed, store, out.absolute() / FIRST_IMAGE_NAME)
    if result["report"] is not None:
        report = out.absolute() / REPORT_NAME
        with storage_errors(f"cannot write {report}"):
            shutil.copyfile(result["report"], report)
        result = {**result, "report": str(report)}
    page = out.absolute() / PAGE_NAME
    with shown_progress():
        recorded = ViewRequest(trajectory=parse_trajectory(RECORDED))
        export_run(store, result["run_id"], "page", recorded, page)
    result = {**result, "page": str(page)}
    if as_json:
        print_json(result)
    else:
        show(result)
        line = f"lidarpainter --store {shlex.quote(str(out / STORE_NAME))} view latest"
        sys.stdout.write(f"A lane aside: open {page}, or drive it live: {line}\n")
