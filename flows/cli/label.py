"""`lidarpainter label`: who moves in a scene, from its LiDAR sweeps."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.cli.output import print_json, print_table, say_status, tell
from flows.cli.shared_options import AsJson, described, refuse_unused

if TYPE_CHECKING:
    from catalog.store import Store

COLUMNS = {
    "found": "found",
    "given": "given as",
    "category": "class",
    "length_m": "length m",
    "width_m": "width m",
    "height_m": "height m",
    "num_frames": "frames",
    "speed_mps": "m/s",
    "score": "score",
}

WORDS = """
name: Name of the new scene in its dataset; its own and "-labelled" if absent, with --edits its
  own and "-edited".
complete: Write a scene that has boxes anew, with those of whoever moves and has none.
edits: File of edits that `view SCENE --label` wrote; the scene is written anew with its boxes so
  changed, and nobody is sought.
"""


@described(WORDS)
def label(
    scene: str,
    name: Annotated[str | None, typer.Option("--as")] = None,
    complete: bool = False,
    edits: Path | None = None,
    as_json: AsJson = False,
) -> None:
    """Find who moves in a scene without boxes, and write it with their boxes as a new scene.

    Of a scene that has boxes it is said who of its moving actors is found, and who moves without a
    box; with --complete it is written with these, with --edits with the boxes as a person changed
    them in `view SCENE --label`.

    Example: lidarpainter label mcap/drive-localised
    """
    if edits is not None:
        refuse_unused("--edits", {"--complete": complete})
    say_status(f"opening {scene}")
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress
    from tasks.ingest.label import compared, ingest_labelled
    from tasks.ingest.label import label as find_movers
    from tasks.opened import open_posed

    store = existing_store()
    if edits is not None:
        _write_edited(store, scene, edits, name, as_json=as_json)
        return
    is_new = complete or name is not None or not open_posed(store, scene).tracks
    with shown_progress():
        found = find_movers(store.address, scene)
        row = ingest_labelled(store.address, scene, found, name) if is_new else None
    rows = compared(store, scene, found)
    if as_json:
        print_json({"scene": scene, "written": row and row["scene_id"], "actors": rows})
        return
    cells = [[one[key] for key in COLUMNS] for one in rows]
    print_table(f"who moves in {scene}", [*COLUMNS.values()], cells, num_text_columns=3)
    if row is not None:
        tell(f"reconstruct it: lidarpainter reconstruct {row['scene_id']}")


def _write_edited(
    store: "Store", scene: str, edits: Path, name: str | None, *, as_json: bool
) -> None:
    """Write a scene anew with its boxes changed, and say what it is called."""
    from flows.cli.progress import shown_progress
    from tasks.ingest.label import ingest_edited

    with shown_progress():
        row = ingest_edited(store.address, scene, edits, name)
    if as_json:
        print_json({"scene": scene, "written": row["scene_id"]})
    else:
        tell(f"reconstruct it: lidarpainter reconstruct {row['scene_id']}")
