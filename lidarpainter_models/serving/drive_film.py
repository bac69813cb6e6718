"""A drive as a film: three cameras side by side, with what is known of each frame drawn in.

Below every image a bar is as long as its confidence: green where the frame is promised to be good,
red where it is more likely bad, yellow in between; grey where a renderer does not say.
"""

import math
from collections.abc import Mapping

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lidarpainter_models.evaluation.view_confidence import PROMISED
from lidarpainter_models.serving.closed_loop import Moment
from lidarpainter_models.serving.sensor_client import SeenFrame

BESIDE_RAD = math.radians(55)
"""Where the cameras to both sides of the middle one look to, about."""
BAR_PX, LINE_PX = 14, 28
GREEN, YELLOW, RED, GREY = (60, 180, 75), (230, 190, 40), (210, 50, 45), (120, 120, 120)
OFF_ROAD = "off the road"


def shown_cameras(rig_from_camera: Mapping[str, Float[Tensor, "4 4"]]) -> tuple[str, ...]:
    """Up to three cameras, from the left one to the right one.

    Args:
        rig_from_camera: where each sits on the car (x forward, y left); it looks along its own z.
    """
    yaw_rad = {
        name: math.atan2(float(pose[1, 2]), float(pose[0, 2]))
        for name, pose in rig_from_camera.items()
    }
    chosen: list[str] = []
    for wanted in (0.0, BESIDE_RAD, -BESIDE_RAD):
        left = [name for name in yaw_rad if name not in chosen]
        if left:
            chosen.append(min(left, key=lambda name: abs(yaw_rad[name] - wanted)))
    return tuple(sorted(chosen, key=lambda name: -yaw_rad[name]))


def film_image(moment: Moment, names: tuple[str, ...]) -> Float[Tensor, "height width 3"]:
    """One image of the film, RGB in [0, 1]."""
    height_px = min(moment.frames[name].rgb_u8.shape[0] for name in names)
    parts = [_with_bar(moment.frames[name], name, height_px) for name in names]
    pictures = np.concatenate(parts, axis=1)
    line = np.full((LINE_PX, pictures.shape[1], 3), 20, np.uint8)
    said = f"{moment.time_s:4.1f} s   {moment.state.speed_mps * 3.6:5.1f} km/h"
    _write(line, f"{said}   {OFF_ROAD if moment.is_off_road else ''}", (8, LINE_PX - 9))
    return torch.from_numpy(np.concatenate([line, pictures])).float() / 255


def _with_bar(frame: SeenFrame, name: str, height_px: int) -> UInt8[np.ndarray, "rows columns 3"]:
    """An image of a height with its name, and the bar below it."""
    height, width = frame.rgb_u8.shape[:2]
    size = (round(width * height_px / height) // 2 * 2, height_px)
    image = cv2.resize(frame.rgb_u8, size, interpolation=cv2.INTER_AREA)
    bar = np.full((BAR_PX, size[0], 3), 40, np.uint8)
    said = frame.confidence
    colour = GREY if said is None else GREEN if said >= PROMISED else RED if said < 0.5 else YELLOW
    bar[3:-3, : round(size[0] * (1.0 if said is None else said))] = colour
    trust = "confidence not told" if said is None else f"confidence {said:.2f}"
    _write(image, f"{name}  {trust}", (6, height_px - 8))
    return np.concatenate([image, bar])


def _write(
    image: UInt8[np.ndarray, "rows columns 3"], text: str, place_px: tuple[int, int]
) -> None:
    """Put white letters on a darkened strip into an image."""
    strip = image[max(place_px[1] - 14, 0) : place_px[1] + 6]
    strip //= 2
    cv2.putText(image, text, place_px, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255,) * 3, 1, cv2.LINE_AA)
