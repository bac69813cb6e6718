"""Whether each camera's images show anything: black or even ones have no edge and no colour.

Grey ones have edges, but sky is told from walls by its colour (`lidar.sky_masks`). An even border,
as of a letterbox, stands before the street wherever the car is.
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
MOST_BORDER_LEVELS, LEAST_STEP_LEVELS = 12.0, 24.0
"""Spread (10th to 90th percentile) of a row of a border over all images, and how far (median) the
second row inside it differs: JPEG rings beside a border, and even sky ends here and there."""
MOST_BORDER_SHARE = 0.45  # of an image's height or width, on each side
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
    empty = {
        name: sum(_even_level(scene, view) is not None for view in scene.views_of(name))
        for name in scene.camera_names
    }
    if some := [f"{count} of {name}'s images" for name, count in empty.items() if count]:
        return "warn", f"{', '.join(some)} show nothing, among others that do: leave them out"
    shares = {name: _border_share(scene, name) for name in scene.camera_names}
    if edged := [f"{name} ({share:.1%} of them)" for name, share in shares.items() if share]:
        return "warn", f"an even border around the images of {', '.join(edged)}: cut it off"
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


def _border_share(scene: DrivingScene, name: str) -> float:
    """Part of a camera's images in an even border that stays the same, on sides that face another.

    On one side alone it may be what is there: a white sky over a level horizon, a dark bonnet.
    """
    views = scene.views_of(name)
    images = [scene.read_image(v).numpy() for v in views[:: -(-len(views) // _NUM_LOOKED_AT)]]
    same_size = [image for image in images if image.shape == images[0].shape]
    grey = np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in same_size])
    top, right, bottom, left = (_border_rows(np.rot90(grey, turn, (1, 2))) for turn in range(4))
    if not (top and bottom):
        top = bottom = 0
    if not (left and right):
        left = right = 0
    height, width = grey.shape[1:]
    return 1 - (height - top - bottom) * (width - left - right) / (height * width)


def _border_rows(grey: UInt8[np.ndarray, "images height width"]) -> int:
    """How many rows at the top of images are an even border."""
    rows = grey[:, : 2 + round(MOST_BORDER_SHARE * grey.shape[1]), ::4].astype(np.float32)
    low, middle, high = np.percentile(rows, (10, 50, 90), axis=(0, 2))
    is_even = (high - low < MOST_BORDER_LEVELS) & (abs(middle - middle[0]) < MOST_BORDER_LEVELS)
    count = int(is_even.argmin())  # 0 where all are
    if not 0 < count < len(middle) - 1:
        return 0
    step = np.median(abs(rows[:, count + 1] - middle[0]))
    return count if step > LEAST_STEP_LEVELS else 0


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
