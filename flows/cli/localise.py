"""`lidarpainter localise`: where the car of a scene drove, from its LiDAR sweeps."""

from typing import Annotated

import typer

from flows.cli.output import print_result, say_status, tell
from flows.cli.shared_options import AsJson, described

WORDS = """
name: Name of the new scene in its dataset; of a scene without poses its own and "-localised" if
  absent.
"""


@described(WORDS)
def localise(
    scene: str,
    name: Annotated[str | None, typer.Option("--as")] = None,
    as_json: AsJson = False,
) -> None:
    """Find the poses of a scene that has none, and write it with them as a new scene.

    Of a scene that has poses it is said how far they differ from what its sweeps tell; with --as
    it is written with what they tell. The doctor looks at the new scene; it ends with code 2 where
    that fails.

    Example: lidarpainter localise mcap/drive
    """
    say_status(f"opening {scene}")
    from catalog.store import existing_store
    from flows.cli.doctor import tell_findings
    from flows.cli.progress import shown_progress
    from tasks.ingest.data_checks import check_stored_scene
    from tasks.ingest.localise import ingest_localised
    from tasks.ingest.localise import localise as find_poses
    from tasks.opened import open_scene

    store = existing_store()
    is_new = name is not None or not open_scene(store, scene).has_poses
    with shown_progress():
        found = find_poses(store.address, scene)
        row = ingest_localised(store.address, scene, found, name) if is_new else None
    told = {
        "scene": scene,
        "num_frames": found.summary["num_frames"],
        "way_m": found.summary["way_m"],
        **(found.summary["recorded"] or {}),
    }
    if row is None:
        print_result(f"poses of {scene}", told, as_json=as_json)
        return
    if not as_json:
        print_result(f"poses of {scene}", {**told, "written": row["scene_id"]}, as_json=False)
        tell(f"reconstruct it: lidarpainter reconstruct {row['scene_id']}")
    findings = check_stored_scene(store, row["scene_id"], None)
    tell_findings("scene", row["scene_id"], findings, as_json=as_json, more=told)
