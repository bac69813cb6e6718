"""`lidarpainter doctor`: is this machine, this scene or this dataset fit for work?"""

import sys
from pathlib import Path
from typing import Annotated

import typer

from flows.cli.output import loudness, print_json, print_table, say_status
from flows.cli.shared_options import AsJson, described

UNFIT = 2

WORDS = """
subject: A stored scene (dataset/sequence), or the name of a dataset; if absent, the setup of this
  machine is checked.
root: The folder of that dataset, as downloaded; only with a dataset's name.
out: File that the overlay image is written to; if absent, one in the store's folder doctor.
"""


@described(WORDS)
def doctor(
    subject: Annotated[str | None, typer.Argument()] = None,
    root: Annotated[Path | None, typer.Argument()] = None,
    out: Path | None = None,
    as_json: AsJson = False,
) -> None:
    """Check the setup, a stored scene, or a dataset on disk.

    Examples: lidarpainter doctor

    A log before it is ingested: lidarpainter doctor pandaset /data/pandaset

    A stored scene: lidarpainter doctor pandaset/002 --out overlay.png
    """
    say_status(f"looking at {subject or 'the environment'}")
    from catalog.store import existing_store, open_store
    from tasks import health
    from tasks.ingest import data_checks

    if subject is None:
        findings = health.check_environment(open_store().root)
    elif root is not None:
        findings = data_checks.check_dataset(open_store(), subject, root, out)
    else:
        findings = data_checks.check_stored_scene(existing_store(), subject, out, _looking_at)
    is_fit = all(finding.verdict != "fail" for finding in findings)
    if as_json:
        rows = [
            {"name": finding.name, "verdict": finding.verdict, "detail": finding.detail}
            for finding in findings
        ]
        print_json({"subject": subject or "environment", "is_fit": is_fit, "findings": rows})
    else:
        cells = [[finding.name, finding.verdict, finding.detail] for finding in findings]
        print_table(
            subject or "environment", ["what", "verdict", "detail"], cells, num_text_columns=3
        )
    if not is_fit:
        raise typer.Exit(UNFIT)


def _looking_at(name: str) -> None:
    """Say what is looked at next: in one place of a terminal, in lines of a file."""
    if sys.stderr.isatty():
        say_status(f"looking at {name}")
    elif loudness() != "quiet":
        sys.stderr.write(f"looking at {name}\n")
        sys.stderr.flush()
