"""`lidarpainter demo`: see the whole pipeline work, without any data."""

import shutil
from pathlib import Path
from typing import Annotated

import typer

from flows.cli.output import print_json

REPORT_NAME = "report.html"


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the report and the store.")] = Path("demo"),
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Any setting: fit.steps=500. May be repeated."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Run the built-in street through the whole pipeline; ends with report.html in --out."""
    from catalog.errors import storage_errors
    from catalog.store import open_store
    from flows.cli.reconstruct import show
    from flows.cli.running import run_demo
    from flows.demo import demo_parameters
    from flows.overrides import with_overrides

    parameters = with_overrides(demo_parameters(), settings or [])
    result = run_demo(parameters, open_store(out / "store"))
    report = out.absolute() / REPORT_NAME
    with storage_errors(f"cannot write {report}"):
        shutil.copyfile(result["report"], report)
    result = {**result, "report": str(report)}
    if as_json:
        print_json(result)
    else:
        show(result)
