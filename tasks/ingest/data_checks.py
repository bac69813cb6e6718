"""Whether a stored scene makes sense, and whether a dataset on disk can be read."""

import json
import tempfile
from dataclasses import asdict
from pathlib import Path

from catalog.errors import CatalogError
from catalog.store import Store
from lidarpainter_models.checks.doctor import check_scene, draw_overlay
from lidarpainter_models.errors import LidarPainterError
from lidarpainter_models.export.images import write_png
from lidarpainter_models.lidar.recording_faults import find_faults
from lidarpainter_models.observations.own_body import in_words, own_bodies
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes.driving_scene import DrivingScene
from tasks.health import Finding
from tasks.ingest.sequences import find_sequences
from tasks.opened import open_scene

TRIAL_FRAMES = slice(0, 6)
"""A dataset is tried on this much of each sequence: enough to tell how its cameras are turned."""


def check_stored_scene(store: Store, scene_id: str, out: Path | None) -> list[Finding]:
    """Check a scene of the store; writes an overlay image and all findings as JSON.

    `out` is a file or folder for the overlay image, by default the store's folder `doctor`; the
    JSON lies beside it under the same name.
    """
    scene = open_scene(store, scene_id)
    path = out or store.root / "doctor" / scene.dataset / f"{scene.sequence}.png"
    if path.suffix != ".png":
        path = path / "overlay.png"
    return _examined(scene, path, [*_findings(scene), _camera_faults(scene), _own_bodies(scene)])


def check_dataset(store: Store, dataset: str, root: Path, out: Path | None) -> list[Finding]:
    """Check the first frames of every sequence of a dataset, read into a folder then removed.

    Overlay images and JSON files go to `out`, by default to the store's folder `doctor`.
    """
    findings = []
    for sequence in find_sequences(dataset, root):
        with tempfile.TemporaryDirectory(prefix="lidarpainter-doctor-") as trial:
            try:
                path = ingest_scene(dataset, root, sequence, Path(trial), frames=TRIAL_FRAMES)
                image = (out or store.root / "doctor" / dataset) / f"{sequence}.png"
                scene = DrivingScene.open(path)
                found = _examined(scene, image, _findings(scene))
            except (LidarPainterError, CatalogError) as error:
                found = [Finding("reading", "fail", str(error))]
        findings += [Finding(f"{sequence}: {f.name}", f.verdict, f.detail) for f in found]
    return findings


def _examined(scene: DrivingScene, image: Path, found: list[Finding]) -> list[Finding]:
    """All findings about a scene, after writing its overlay image and the JSON beside it."""
    findings = [*found, Finding("overlay", "ok", str(_write_overlay(scene, image)))]
    report = {
        "scene": f"{scene.dataset}/{scene.sequence}",
        "content_digest": scene.content_digest,
        "is_fit": all(finding.verdict != "fail" for finding in findings),
        "findings": [asdict(finding) for finding in findings],
    }
    file = image.with_suffix(".json")
    file.write_text(json.dumps(report, indent=2) + "\n", "utf-8")
    return [*findings, Finding("report", "ok", str(file))]


def _findings(scene: DrivingScene) -> list[Finding]:
    return [Finding(check.name, check.verdict, check.detail) for check in check_scene(scene)]


def _camera_faults(scene: DrivingScene) -> Finding:
    """What a fit would correct about the cameras; a trial of a few frames says too little."""
    faults = find_faults(scene, scene.views)
    said = [f"{name} {fault}" for name, fault in faults.items()]
    if not said:
        return Finding("camera faults", "ok", "clocks, angles and readouts are as stored")
    return Finding("camera faults", "warn", f"{'; '.join(said)} in a fit")


def _own_bodies(scene: DrivingScene) -> Finding:
    """Which cameras show the recording car, which a fit leaves out."""
    found = own_bodies(scene, scene.views)
    said = [in_words(name, body) for name, body in found.items()]
    return Finding("own body", "ok", " ".join(said) or "no camera shows the recording car")


def _write_overlay(scene: DrivingScene, path: Path) -> Path:
    frame_index = scene.frame_indices[len(scene.frame_indices) // 2]
    rgb_u8 = draw_overlay(scene, frame_index, scene.camera_names[0])
    return write_png(rgb_u8.float() / 255, path)
