"""A drive as a small moving picture: what was recorded beside what the scene shows a step aside."""

import base64
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.export.images import to_bytes
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.shifts import Shift

PANEL_WIDTH_PX = 360
QUALITY = 60
MOST_MOMENTS = 40
"""From the middle of the log; four seconds at 10 Hz."""
SHORTEST_MS = 40


@dataclass(frozen=True, kw_only=True)
class MovingPicture:
    """An animated picture that stands inside a page."""

    data_url: str
    caption: str


def recorded_beside(held_out: HeldOut, fitted: GaussianScene, shift: Shift) -> MovingPicture:
    """The first judged camera's drive: left as recorded, right from a step aside."""
    views = held_out.scene.views_of(held_out.test_views[0].camera_name)
    first = max((len(views) - MOST_MOMENTS) // 2, 0)
    views = views[first : first + MOST_MOMENTS]
    frames = []
    for view in views:
        camera = held_out.shifted_camera(fitted, view, shift)
        aside = fitted.render(camera, view.timestamp_ns, camera_name=view.camera_name)
        panels = (_panel(held_out.image_of(view)), _panel(aside.rgb))
        frames.append(np.hstack(panels))
    animation = cv2.Animation()
    animation.frames = frames
    animation.durations = _durations_ms([view.timestamp_ns for view in views])
    settings = [cv2.IMWRITE_WEBP_QUALITY, QUALITY]
    _, encoded = cv2.imencodeanimation(".webp", animation, settings)
    data = base64.b64encode(encoded.tobytes()).decode("ascii")
    return MovingPicture(
        data_url=f"data:image/webp;base64,{data}",
        caption=f"Left: recorded by {views[0].camera_name}. Right: the scene, {shift.name}.",
    )


def _panel(rgb: Float[Tensor, "height width 3"]) -> np.ndarray:
    bgr = cv2.cvtColor(to_bytes(rgb), cv2.COLOR_RGB2BGR)
    height_px = max(round(bgr.shape[0] * PANEL_WIDTH_PX / bgr.shape[1]), 1)
    return cv2.resize(bgr, (PANEL_WIDTH_PX, height_px), interpolation=cv2.INTER_AREA)


def _durations_ms(times_ns: list[int]) -> list[int]:
    """How long every frame stands; the last one as long as the one before."""
    steps = [max(after - before, 0) // 1_000_000 for before, after in pairwise(times_ns)]
    steps = [max(step, SHORTEST_MS) for step in steps]
    return [*steps, steps[-1] if steps else 100]
