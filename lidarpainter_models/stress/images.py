"""Faults of pictures: exposure, white balance, blur, night, dirt, pictures swapped or lost."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from lidarpainter_models.stress.frames import Frame, Shot

GAMMA = 2.2
"""Exponent between image values and light, about; light is changed in linear units."""
NIGHT_NOISE = 0.02
"""Standard deviation of the noise of a pixel at full darkness, of full scale."""
GREY, DENSITY = 90, 0.9
"""The grey level of dirt (of 255), and the share of light that it takes."""
SPOTS = 12
"""Number of blots on a dirty lens; a camera has the same ones in every image."""


def exposure(frame: Frame, level: float, dice: np.random.Generator) -> Frame:
    """Brightness jumps from picture to picture, by up to a share of it."""

    def jumped(shot: Shot, _: int) -> Shot:
        factor = 1 + dice.uniform(-level, level)
        return shot.with_pixels(lambda bgr: 255 * (bgr / 255) * factor ** (1 / GAMMA))

    return _each(frame, jumped)


def white_balance(frame: Frame, level: float, dice: np.random.Generator) -> Frame:
    """Red and blue jump against each other from picture to picture."""

    def tinted(shot: Shot, _: int) -> Shot:
        tilt = 1 + dice.uniform(-level, level)
        return shot.with_pixels(lambda bgr: bgr * np.array([1 / tilt, 1, tilt], np.float32))

    return _each(frame, tinted)


def motion_blur(frame: Frame, level: float, _dice: np.random.Generator) -> Frame:
    """Pictures smeared sideways over so many pixels of a thousand of their width."""

    def smeared(bgr: np.ndarray) -> np.ndarray:
        length = max(round(level * bgr.shape[1] / 1000), 1)
        return cv2.blur(bgr, (length, 1))

    return _each(frame, lambda shot, _: shot.with_pixels(smeared))


def darkness(frame: Frame, level: float, dice: np.random.Generator) -> Frame:
    """So much of the light is gone, and noise of the sensor takes its place."""

    def dark(bgr: np.ndarray) -> np.ndarray:
        light = (1 - level) * (bgr / 255) ** GAMMA
        noise = level * NIGHT_NOISE * dice.standard_normal(bgr.shape)
        return 255 * (light + noise).clip(0, 1) ** (1 / GAMMA)

    return _each(frame, lambda shot, _: shot.with_pixels(dark))


def dirt(frame: Frame, level: float, _dice: np.random.Generator) -> Frame:
    """Grey blots on every lens, as wide as a share of the picture, at the same place for ever."""

    def blotted(shot: Shot, number: int) -> Shot:
        places = np.random.default_rng(number).uniform(0, 1, (SPOTS, 2))

        def change(bgr: np.ndarray) -> np.ndarray:
            height, width = bgr.shape[:2]
            veil = np.zeros((height, width), np.float32)
            for x, y in places:
                centre = int(x * width), int(y * height)
                cv2.circle(veil, centre, max(round(level * width / 2), 1), 1.0, cv2.FILLED)
            soft = cv2.GaussianBlur(veil, (0, 0), max(level * width / 8, 0.5))[..., None]
            return bgr + DENSITY * soft * (GREY - bgr)

        return shot.with_pixels(change)

    return _each(frame, blotted)


def swapped_cameras(frame: Frame, level: float, _dice: np.random.Generator) -> Frame:
    """The pictures of the first pairs of cameras of one size have changed places."""
    shots = list(frame.images)
    for first in range(0, min(2 * int(level), len(shots) - 1), 2):
        one, two = shots[first], shots[first + 1]
        if _size(one) == _size(two):
            shots[first] = replace(one, jpeg=two.jpeg)
            shots[first + 1] = replace(two, jpeg=one.jpeg)
    return replace(frame, images=tuple(shots))


def missing_cameras(frame: Frame, level: float, _dice: np.random.Generator) -> Frame:
    """So many cameras are not there, the last ones; one always stays."""
    return replace(frame, images=frame.images[: max(len(frame.images) - int(level), 1)])


def _each(frame: Frame, change: Callable[[Shot, int], Shot]) -> Frame:
    shots = tuple(change(shot, number) for number, shot in enumerate(frame.images))
    return replace(frame, images=shots)


def _size(shot: Shot) -> tuple[int, int]:
    return shot.record.camera.width_px, shot.record.camera.height_px
