"""Whether each camera's images show anything: black or even ones have no edge and no colour.

Grey ones have edges, but sky is told from walls by its colour (`lidar.sky_masks`).
"""

import cv2
import numpy as np
from jaxtyping import UInt8

from lidarpainter_models.checks.verdicts import Verdict
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView

MOST_EVEN_LEVELS = 3.0
"""Spread of the brightness (10th to 90th percentile of 255) of an image that shows nothing; of one
at night, blurred as it is here, it is 20 and more."""
MOST_GREY_LEVELS = 1.0
"""Mean spread between the channels of an image without colour, of 255."""
BLACK, BLACK_LEVEL = "black", 16.0
_NUM_LOOKED_AT = 8
_SIZE_PX = (160, 90)
"""Images are made so small first: noise is none then."""


def check_pictures(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether the images of each camera show something; black ones cannot be meant."""
    if blank := blank_cameras(scene):
        said = "; ".join(f"{name} {words}" for name, words in blank.items())
        is_black = any(words.startswith(f"is {BLACK}") for words in blank.values())
        return "fail" if is_black else "warn", f"{said}: leave it out (ingest --cameras)"
    if grey := [name for name in scene.camera_names if _is_grey(scene, name)]:
        why = "sky is told by its colour, so little of it is found and a fit puts surfaces there"
        return "warn", f"no colour in the images of {', '.join(grey)}: {why}"
    return "ok", "the images of each camera show something"


def blank_cameras(scene: DrivingScene) -> dict[str, str]:
    """What is to be said of cameras whose images show nothing, all of them, by name."""
    said = {}
    for name in scene.camera_names:
        views = scene.views_of(name)
        step = -(-len(views) // _NUM_LOOKED_AT)
        if all(_even_level(scene, view) is not None for view in views[::step]):
            levels = [_even_level(scene, view) for view in views]
            even = [level for level in levels if level is not None]
            if len(even) == len(views):
                look = BLACK if max(even) < BLACK_LEVEL else "of one even brightness"
                said[name] = f"is {look} in all {len(views)} images"
    return said


def _is_grey(scene: DrivingScene, name: str) -> bool:
    """Whether a camera's images have no colour."""
    views = scene.views_of(name)
    return all(
        float(np.ptp(_small(scene, view), axis=2).mean()) < MOST_GREY_LEVELS
        for view in views[:: -(-len(views) // _NUM_LOOKED_AT)]
    )


def _small(scene: DrivingScene, view: RecordedView) -> UInt8[np.ndarray, "height width 3"]:
    return cv2.resize(scene.read_image(view).numpy(), _SIZE_PX, interpolation=cv2.INTER_AREA)


def _even_level(scene: DrivingScene, view: RecordedView) -> float | None:
    """Brightness of an image that shows nothing; None of one that shows something."""
    grey = cv2.cvtColor(_small(scene, view), cv2.COLOR_RGB2GRAY)
    low, middle, high = np.percentile(grey, (10, 50, 90))
    return float(middle) if high - low < MOST_EVEN_LEVELS else None
