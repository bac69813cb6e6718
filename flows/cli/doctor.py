"""`lidarpainter doctor`: is this machine, this scene or this dataset fit for work?"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

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
    tell_findings("subject", subject or "environment", findings, as_json=as_json)


def tell_findings(
    kind: str,
    subject: str,
    findings: Sequence[Any],
    *,
    as_json: bool,
    more: Mapping[str, Any] | None = None,
) -> None:
    """Print what checks found, as a table or one object; a failure ends the command with code 2.

    Args:
        kind: what the object calls the subject.
        subject: what was looked at.
        findings: each with `name`, `verdict` and `detail`.
        as_json: whether one object is printed.
        more: further entries of the object.
    """
    is_fit = all(finding.verdict != "fail" for finding in findings)
    rows = [(finding.name, finding.verdict, finding.detail) for finding in findings]
    columns = ("name", "verdict", "detail")
    if as_json:
        found = [dict(zip(columns, row, strict=True)) for row in rows]
        print_json({**(more or {}), kind: subject, "is_fit": is_fit, "findings": found})
    else:
        print_table(subject, ["what", *columns[1:]], rows, num_text_columns=3)
    if not is_fit:
        raise typer.Exit(UNFIT)


def _looking_at(name: str) -> None:
    """Say what is looked at next: in one place of a terminal, in lines of a file."""
    if sys.stderr.isatty():
        say_status(f"looking at {name}")
    elif loudness() != "quiet":
        sys.stderr.write(f"looking at {name}\n")
        sys.stderr.flush()
