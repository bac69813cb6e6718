"""`lidarpainter rig`: what a bag holds, and a rig.toml for it."""

import sys
from pathlib import Path

import typer

from flows.cli.output import complain, print_json, print_table, say_status, tell
from flows.cli.shared_options import AsJson, described

INCOMPLETE = 2
COLUMNS = {
    "topic": "topic",
    "schema": "schema",
    "kind": "read as",
    "frame": "frame",
    "messages": "messages",
    "hz": "a second",
}

WORDS = """
file: The bag: an MCAP file, or the folder of a split one.
out: File that the proposed rig.toml is written to; if absent, it is printed.
"""


@described(WORDS)
def rig(file: Path, out: Path | None = None, as_json: AsJson = False) -> None:
    """Look into a bag, propose which topics are which sensor, and say what is missing.

    With --out a table of the topics is printed. The exit code is 2 where something is missing.

    Example: lidarpainter rig drive.mcap --out rig.toml

    Then: lidarpainter ingest mcap drive.mcap --map rig.toml
    """
    say_status(f"reading {file}")
    from lidarpainter_models.storage.whole_files import write_whole
    from tasks.ingest.rigs import propose_rig

    found = propose_rig(file)
    if out is not None and found["rig"] is not None:
        write_whole(out, found["rig"].encode())
    if as_json:
        print_json({"file": str(file), "out": out and str(out), **found})
    elif out is None:
        sys.stdout.write(found["rig"] or "")
    else:
        rows = [[row[name] for name in COLUMNS] for row in found["topics"]]
        print_table(f"topics of {file.name}", [*COLUMNS.values()], rows, num_text_columns=4)
        tell(f"the proposed rig is in {out}")
    for line in found["missing"]:
        complain(f"missing: {line}")
    if found["missing"]:
        raise typer.Exit(INCOMPLETE)
