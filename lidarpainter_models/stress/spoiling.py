"""A stored scene with a fault, in all frames or in those that train; the others are as recorded."""

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.rewriting import header_of
from lidarpainter_models.scenes.splits import split_views
from lidarpainter_models.scenes.writer import SceneWriter
from lidarpainter_models.stress.causes import cause_of
from lidarpainter_models.stress.frames import read_frame

DATASET = "stress"
GENERATOR = "generator"
"""Entry of a street's manifest by which its exact truth is drawn."""
STRESS = "stress"
"""Entry of a spoilt scene's manifest: see `spoilt_from`."""
SPLIT = "alternate"


def spoilt_from(scene: DrivingScene, cause: str, level: float) -> dict[str, Any]:
    """What the manifest of a spoilt scene says of it: another fault of this one says another thing.

    Raises:
        ConfigError: there is no such cause.
    """
    return {
        "scene": scene.content_digest,
        "cause": cause,
        "level": level,
        "frames": "all" if cause_of(cause).is_of_log else "training",
    }


def spoilt_name(scene: DrivingScene, cause: str, level: float) -> str:
    """Name of the sequence that a fault makes of a scene."""
    return f"{scene.dataset}-{scene.sequence}-{cause}-{level:g}"


def write_spoilt(
    scene: DrivingScene,
    cause: str,
    level: float,
    store: Path,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a scene anew with a fault; returns the folder of the new scene.

    It is written as `stress/DATASET-SEQUENCE-CAUSE-LEVEL`; the level is one of the cause's own, or
    another.

    Raises:
        ConfigError: there is no such cause.
    """
    fault = cause_of(cause)
    more = {GENERATOR: scene.manifest[GENERATOR]} if GENERATOR in scene.manifest else {}
    header = header_of(scene, {**more, STRESS: spoilt_from(scene, cause, level)})
    train = split_views(scene, SPLIT).train_frames
    name = spoilt_name(scene, cause, level)
    with SceneWriter(store, DATASET, name, header) as writer:
        for done, frame_index in enumerate(scene.frame_indices, start=1):
            frame = read_frame(scene, frame_index)
            if frame_index in train or fault.is_of_log:
                seed = zlib.crc32(f"{cause} {frame_index}".encode())
                frame = fault.spoil(frame, level, np.random.default_rng(seed))
            frame.write(writer)
            if progress is not None:
                progress(done, len(scene.frame_indices))
        writer.set_provenance({"spoilt": f"{scene.dataset}/{scene.sequence}"})
    return writer.path
