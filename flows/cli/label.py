"""`lidarpainter label`: who moves in a scene, from its LiDAR sweeps."""

from typing import Annotated

import typer

from flows.cli.output import print_json, print_table, say_status, tell
from flows.cli.shared_options import AsJson, described

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
name: Name of the new scene in its dataset; its own and "-labelled" if absent.
complete: Write a scene that has boxes anew, with those of whoever moves and has none.
"""


@described(WORDS)
def label(
    scene: str,
    name: Annotated[str | None, typer.Option("--as")] = None,
    complete: bool = False,
    as_json: AsJson = False,
) -> None:
    """Find who moves in a scene without boxes, and write it with their boxes as a new scene.

    Of a scene that has boxes it is said who of its moving actors is found, and who moves without a
    box; with --complete it is written with these.

    Example: lidarpainter label mcap/drive-localised
    """
    say_status(f"opening {scene}")
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress
    from tasks.ingest.label import compared, ingest_labelled
    from tasks.ingest.label import label as find_movers
    from tasks.opened import open_posed

    store = existing_store()
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
