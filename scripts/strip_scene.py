"""Write scenes of a store as if nobody knew where the car drove, nor who is where.

    python scripts/strip_scene.py STORE pandaset/002 ...

DATASET/NAME becomes DATASET/NAME-stripped: what `localise` and `label` have to find is taken away.
"""

import sys
from pathlib import Path

from catalog.store import open_store
from lidarpainter_models.lidar.localised import write_without_poses
from tasks.ingest.ingest import record_scene, writing
from tasks.opened import open_scene

SUFFIX = "-stripped"


def main(folder: str, *scene_ids: str) -> None:
    """Strip some scenes of a store."""
    store = open_store(Path(folder))
    for scene_id in scene_ids:
        scene = open_scene(store, scene_id)
        with writing(store, scene_id + SUFFIX):
            path = write_without_poses(scene, store.root, scene.sequence + SUFFIX)
        sys.stdout.write(f"{record_scene(store, path)['scene_id']}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
