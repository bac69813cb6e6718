"""`lidarpainter check-bundle`: what a simulator's user would miss in a bundle."""

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.output import print_json, print_table, say_status
from flows.cli.shared_options import AsJson, described

UNFIT = 2

WORDS = """
file: The bundle, a .usdz file of anybody.
"""


@described(WORDS)
def check_bundle(file: Annotated[Path, typer.Argument()], as_json: AsJson = False) -> None:
    """Say what somebody who loads a bundle into AlpaSim or CARLA would miss.

    Example: lidarpainter check-bundle scene.usdz
    """
    say_status(f"looking at {file}")
    from lidarpainter_models.export import bundle_checks

    findings = bundle_checks.check_bundle(file)
    is_fit = all(finding.verdict != "fail" for finding in findings)
    if as_json:
        rows = [
            {"name": finding.name, "verdict": finding.verdict, "detail": finding.detail}
            for finding in findings
        ]
        print_json({"bundle": str(file), "is_fit": is_fit, "findings": rows})
    else:
        cells = [[finding.name, finding.verdict, finding.detail] for finding in findings]
        print_table(str(file), ["what", "verdict", "detail"], cells, num_text_columns=3)
    if not is_fit:
        raise typer.Exit(UNFIT)
