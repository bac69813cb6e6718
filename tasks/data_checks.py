"""Whether a stored scene makes sense, and whether a dataset on disk can be read."""

import tempfile
from pathlib import Path

from catalog.errors import CatalogError
from catalog.store import Store
from lidarpainter_models.errors import LidarPainterError
from lidarpainter_models.export.pictures import write_png
from lidarpainter_models.scenes.doctor import check_scene, draw_overlay
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.readers import ingest_scene, list_sequences
from tasks.health import Finding
from tasks.scenes import open_scene

TRIAL_FRAMES = slice(0, 2)
"""A dataset is tried on this much of each sequence: enough to meet every kind of file."""


def check_stored_scene(store: Store, scene_id: str, out: Path | None) -> list[Finding]:
    """Check a scene of the store and draw points and boxes over one of its pictures.

    Args:
        store: where the scene is.
        scene_id: `<dataset>/<sequence>`.
        out: file or folder of the overlay picture; by default in the store's folder `doctor`.
    """
    scene = open_scene(store, scene_id)
    path = out or store.root / "doctor" / scene.dataset / f"{scene.sequence}.png"
    if path.suffix != ".png":
        path = path / "overlay.png"
    return [*_findings(scene), Finding("overlay", "ok", str(_write_overlay(scene, path)))]


def check_dataset(dataset: str, root: Path) -> list[Finding]:
    """Read the first frames of every sequence of a dataset into a folder that is then removed."""
    findings = []
    for sequence in list_sequences(dataset, root):
        with tempfile.TemporaryDirectory(prefix="lidarpainter-doctor-") as trial:
            try:
                path = ingest_scene(dataset, root, sequence, Path(trial), frames=TRIAL_FRAMES)
                failed = [
                    found for found in _findings(DrivingScene.open(path)) if found.verdict == "fail"
                ]
            except (LidarPainterError, CatalogError) as error:
                failed = [Finding("reading", "fail", str(error))]
        if failed:
            findings += [Finding(f"{sequence}: {f.name}", f.verdict, f.detail) for f in failed]
        else:
            findings.append(Finding(sequence, "ok", "its first frames can be read"))
    return findings


def _findings(scene: DrivingScene) -> list[Finding]:
    return [Finding(check.name, check.verdict, check.detail) for check in check_scene(scene)]


def _write_overlay(scene: DrivingScene, path: Path) -> Path:
    frame_index = scene.frame_indices[len(scene.frame_indices) // 2]
    rgb_u8 = draw_overlay(scene, frame_index, scene.camera_names[0])
    return write_png(rgb_u8.float() / 255, path)
