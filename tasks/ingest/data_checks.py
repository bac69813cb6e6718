"""Whether a stored scene makes sense, and whether a dataset on disk can be read."""

import json
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from catalog.errors import CatalogError
from catalog.store import Store
from lidarpainter_models.checks.doctor import check_scene, draw_overlay
from lidarpainter_models.errors import LidarPainterError, SceneError
from lidarpainter_models.export.images import write_png
from lidarpainter_models.lidar.exposure_differences import exposure_differences
from lidarpainter_models.lidar.recording_faults import find_faults
from lidarpainter_models.observations.own_body import in_words, own_bodies
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes.driving_scene import DrivingScene
from tasks.health import Finding
from tasks.ingest.bucket_roots import root_at_hand
from tasks.ingest.sequences import find_sequences
from tasks.opened import open_scene

CAMERA_FAULTS = "camera faults"
CORRECTS = "--set observation.corrects_cameras=true"
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
    return _examined(scene, path, findings_about(scene))


def findings_about(
    scene: DrivingScene, progress: Callable[[int, int], None] = lambda _done, _total: None
) -> list[Finding]:
    """Everything that is looked for in a whole scene; a trial of a few frames says too little."""
    looks = [_findings, _camera_faults, *([_exposure] if scene.lidar_names else []), _own_bodies]
    found = []
    for done, look in enumerate(looks, start=1):
        found += look(scene)
        progress(done, len(looks))
    return found


def check_dataset(store: Store, dataset: str, root: Path, out: Path | None) -> list[Finding]:
    """Check the first frames of every sequence of a dataset, read into a folder then removed.

    Overlay images and JSON files go to `out`, by default to the store's folder `doctor`.
    """
    findings = []
    for sequence in find_sequences(dataset, root):
        with tempfile.TemporaryDirectory(prefix="lidarpainter-doctor-") as trial:
            try:
                with root_at_hand(root, sequence) as folder:
                    path = ingest_scene(dataset, folder, sequence, Path(trial), frames=TRIAL_FRAMES)
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


def _camera_faults(scene: DrivingScene) -> list[Finding]:
    """What a fit can correct about the cameras."""
    faults = find_faults(scene, scene.views)
    said = [f"{name} {fault}" for name, fault in faults.items()]
    if not said:
        return [Finding(CAMERA_FAULTS, "ok", "clocks, angles and readouts are as stored")]
    return [Finding(CAMERA_FAULTS, "warn", f"{'; '.join(said)} ({CORRECTS} corrects it in a fit)")]


def _exposure(scene: DrivingScene) -> list[Finding]:
    """How images differ in brightness."""
    try:
        said = exposure_differences(scene)
    except SceneError as error:
        return [Finding("exposure", "fail", str(error))]
    if not said:
        return [Finding("exposure", "ok", "images are exposed alike")]
    return [Finding("exposure", "warn", "; ".join(said))]


def _own_bodies(scene: DrivingScene) -> list[Finding]:
    """Which cameras show the recording car, which a fit leaves out."""
    found = own_bodies(scene, scene.views)
    said = [in_words(name, body) for name, body in found.items()]
    return [Finding("own body", "ok", " ".join(said) or "no camera shows the recording car")]


def _write_overlay(scene: DrivingScene, path: Path) -> Path:
    of_camera = scene.views_of(scene.views[0].camera_name)
    rgb_u8 = draw_overlay(scene, of_camera[len(of_camera) // 2])
    return write_png(rgb_u8.float() / 255, path)
