"""`lidarpainter check-bundle`: what a simulator's user would miss in a bundle."""

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.doctor import tell_findings
from flows.cli.output import say_status
from flows.cli.shared_options import AsJson, described

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

    tell_findings("bundle", str(file), bundle_checks.check_bundle(file), as_json=as_json)
