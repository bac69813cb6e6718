"""`lidarpainter demo`: see the whole pipeline work, without any data."""

import shutil
from pathlib import Path
from typing import Annotated

import typer

from flows.cli.output import print_json, say_status
from flows.cli.shared_options import AsJson, Painter, Settings, check_painter

FIRST_IMAGE_NAME = "street.png"
REPORT_NAME = "report.html"


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the report and the store.")] = Path("demo"),
    seed: Annotated[
        int, typer.Option(min=0, max=999, help="Which street; painters train on other seeds.")
    ] = 1,
    painter: Painter = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Run the built-in street through the whole pipeline.

    Into --out come street.png, what the camera saw first, after a minute, and report.html in the
    end.

    Example: lidarpainter demo --out demo
    """
    from catalog.errors import storage_errors
    from catalog.store import open_store
    from flows.cli.reconstruct import show
    from flows.cli.running import run_demo
    from flows.overrides import with_changes, with_overrides
    from flows.presets import preview
    from tasks.specs import street_id

    parameters = preview(street_id(seed))
    if painter is not None:
        parameters = with_changes(parameters, {"painter": painter})
    parameters = with_overrides(parameters, settings or [])
    say_status(f"drawing the street of seed {seed}")
    check_painter(painter)
    store = open_store(out / "store")
    result = run_demo(parameters, seed, store, out.absolute() / FIRST_IMAGE_NAME)
    if result["report"] is not None:
        report = out.absolute() / REPORT_NAME
        with storage_errors(f"cannot write {report}"):
            shutil.copyfile(result["report"], report)
        result = {**result, "report": str(report)}
    if as_json:
        print_json(result)
    else:
        show(result)
