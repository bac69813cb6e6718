"""Whether a stored scene makes sense, and whether a dataset on disk can be read."""

import json
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from catalog.errors import CatalogError
from catalog.store import Store
from lidarpainter_models.checks.calibration import CameraTurn
from lidarpainter_models.checks.doctor import check_scene, not_computed
from lidarpainter_models.checks.overlay import draw_overlay, with_legend
from lidarpainter_models.checks.pictures import blank_cameras
from lidarpainter_models.errors import LidarPainterError, SceneError
from lidarpainter_models.export.images import write_png
from lidarpainter_models.lidar.exposure_differences import exposure_differences
from lidarpainter_models.lidar.spatiotemporal_calibration import (
    cannot_be_told,
    find_faults,
    images_agree,
)
from lidarpainter_models.observations import own_body
from lidarpainter_models.observations.own_body import in_words, own_bodies
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes.driving_scene import DrivingScene
from tasks.health import Finding
from tasks.ingest.bucket_roots import root_at_hand
from tasks.ingest.sequences import find_sequences
from tasks.opened import open_scene

LookingAt = Callable[[str], None]
"""Told the name of what is looked at next."""
Bodies = Callable[[], dict[str, Bool[np.ndarray, "height width"]]]
"""What of each camera's images is the recording car, found when it is first asked for."""
CAMERA_FAULTS = "camera faults"
CORRECTS = "--set observation.corrects_cameras=true"
TRIAL_FRAMES = slice(0, 6)
"""A dataset is tried on this much of each sequence: enough to tell how its cameras are turned."""
LOOKED_AT = (0.35, 0.87, 0.99, 1.0)
"""Part of the time that is over after each look of `findings_about`: of four logs."""


def check_stored_scene(
    store: Store, scene_id: str, out: Path | None, looking_at: LookingAt = lambda _name: None
) -> list[Finding]:
    """Check a scene of the store; writes an overlay image and all findings as JSON.

    Args:
        store: where the scene is.
        scene_id: its dataset and sequence, with a slash between.
        out: a file or folder for the overlay image, by default the store's folder `doctor`; the
            JSON lies beside it under the same name.
        looking_at: told what is looked at next.
    """
    scene = open_scene(store, scene_id)
    path = out or store.root / "doctor" / scene.dataset / f"{scene.sequence}.png"
    if path.suffix != ".png":
        path = path / "overlay.png"
    return _examined(scene, path, findings_about(scene, looking_at=looking_at))


def findings_about(
    scene: DrivingScene,
    progress: Callable[[float, float], None] = lambda _done, _total: None,
    looking_at: LookingAt = lambda _name: None,
) -> list[Finding]:
    """Everything that is looked for in a whole scene; a trial of a few frames says too little."""
    bodies = cache(partial(own_bodies, scene, scene.views))
    looks: dict[str, Callable[[], list[Finding]]] = {
        "scene": lambda: _findings(scene, bodies, looking_at),
        CAMERA_FAULTS: lambda: _camera_faults(scene, bodies),
        "exposure": lambda: _exposure(scene) if scene.lidar_names else [],
        "own body": lambda: _own_bodies(scene, bodies),
    }
    found: list[Finding] = []
    for (name, look), share in zip(looks.items(), LOOKED_AT, strict=True):
        looking_at(name)
        try:
            found += look()
        except Exception as error:  # noqa: BLE001 - what one look cannot compute ends no run
            found.append(Finding(name, "warn", not_computed(error)))
        progress(share, 1.0)
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
                bodies = cache(partial(own_bodies, scene, scene.views))
                found = _examined(scene, image, _findings(scene, bodies))
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


def _findings(
    scene: DrivingScene, bodies: Bodies, looking_at: LookingAt = lambda _name: None
) -> list[Finding]:
    def agrees(name: str, turn: CameraTurn) -> bool | None:
        turned_deg = [turn.pitch_deg, turn.yaw_deg, turn.roll_deg]
        return images_agree(scene, name, -np.radians(turned_deg), bodies().get(name))

    checks = check_scene(scene, agrees, looking_at)
    return [Finding(check.name, check.verdict, check.detail) for check in checks]


def _camera_faults(scene: DrivingScene, bodies: Bodies) -> list[Finding]:
    """What a fit can correct about the cameras."""
    untold = cannot_be_told(scene.views)
    faults = find_faults(scene, scene.views, bodies())
    if faults:
        said = "; ".join(f"{name} {fault}" for name, fault in faults.items())
        tried = "views set aside agree better with it"
        return [Finding(CAMERA_FAULTS, "warn", f"{said} ({tried}: {CORRECTS} corrects it)")]
    told = [name for name in scene.camera_names if name not in untold]
    said = f"{', '.join(told)}: clocks, angles and readouts are as stored" if told else ""
    if untold:
        why = "few or coarse images, or a car that stands"
        said += f"{'; ' if told else ''}{', '.join(untold)} cannot be told ({why})"
    return [Finding(CAMERA_FAULTS, "ok", said)]


def _exposure(scene: DrivingScene) -> list[Finding]:
    """How images differ in brightness."""
    if blank := blank_cameras(scene):
        said = "; ".join(f"{name} {words}" for name, words in blank.items())
        return [Finding("exposure", "warn", f"not compared: {said}")]
    try:
        differences = exposure_differences(scene)
    except SceneError as error:
        return [Finding("exposure", "fail", str(error))]
    if not differences:
        return [Finding("exposure", "ok", "images are exposed alike")]
    return [Finding("exposure", "warn", "; ".join(differences))]


def _own_bodies(scene: DrivingScene, bodies: Bodies) -> list[Finding]:
    """Which cameras show the recording car, which a fit leaves out."""
    said = [in_words(name, body) for name, body in bodies().items()]
    whys = own_body.cannot_be_told(scene.views)
    untold = {name: why for name, why in whys.items() if name not in bodies()}
    if len(untold) < len(scene.camera_names):
        who = "No other camera" if said else "No camera"
        said += [f"{who} {'that was checked ' if untold else ''}shows the recording car."]
    said += [f"{name} was not checked ({why})." for name, why in untold.items()]
    said += [
        f"Of where {name} would show it, {share:.0%} was not checked (other cars drive there)."
        for name, share in own_body.behind_traffic(scene, scene.views).items()
        if name not in untold
    ]
    return [Finding("own body", "ok", " ".join(said))]


def _write_overlay(scene: DrivingScene, path: Path) -> Path:
    of_camera = scene.views_of(scene.views[0].camera_name)
    rgb_u8 = with_legend(draw_overlay(scene, of_camera[len(of_camera) // 2]))
    return write_png(rgb_u8.float() / 255, path)
