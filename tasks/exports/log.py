"""Write the recorded log of a scene in a format of logs."""

from pathlib import Path
from typing import Any

from lidarpainter_models.export.formats import ExportFormat
from lidarpainter_models.scenes.driving_scene import DrivingScene
from tasks.exports.places import new_folder
from tasks.progress import listener

STAGE = "export"


def export_log(
    scene: DrivingScene, row: ExportFormat, frames: slice | None, out: Path
) -> dict[str, Any]:
    """Write frames of a recorded scene into a new folder; all of them if None.

    Raises:
        SceneError: no frame is left, or the format has no place for something in the scene.
        MissingPackageError: the format's extra is not installed.
        ConfigError: something is there already.
        WriteError: the disk refuses; nothing is left half-written.
    """
    wanted = frozenset(scene.frame_indices[frames or slice(None)])
    listener().started(STAGE)
    with new_folder(out) as folder:
        made = row.load_writer()(
            folder, scene, wanted, lambda done, total: listener().advanced(STAGE, done, total, "")
        )
    num_bytes = sum(file.stat().st_size for file in out.iterdir())
    return {"path": str(out), "num_bytes": num_bytes, **made}
