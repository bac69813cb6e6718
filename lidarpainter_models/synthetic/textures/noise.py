"""Smooth random fields that textures are made of."""

from typing import Any

import cv2
import numpy as np


def value_noise(
    rng: np.random.Generator, shape: tuple[int, int], cells: tuple[int, int]
) -> np.ndarray:
    """Smooth field in 0..1 that repeats at its edges: a grid of random values, cubic between."""
    rows, columns = max(cells[0], 1), max(cells[1], 1)
    grid = rng.random((rows, columns), dtype=np.float32)
    border = 4
    padded = np.pad(grid, border, mode="wrap")
    x = (np.arange(shape[1], dtype=np.float32) + 0.5) * (columns / shape[1]) - 0.5 + border
    y = (np.arange(shape[0], dtype=np.float32) + 0.5) * (rows / shape[0]) - 0.5 + border
    across = cv2.remap(
        padded,
        np.broadcast_to(x, (padded.shape[0], shape[1])).astype(np.float32),
        np.broadcast_to(
            np.arange(padded.shape[0], dtype=np.float32)[:, None], (padded.shape[0], shape[1])
        ).astype(np.float32),
        cv2.INTER_CUBIC,
    )
    # one axis at a time: the map of a large image would not fit in the short indices of remap
    low = np.floor(y).astype(int)
    fraction = (y - low)[:, None]
    smooth = fraction * fraction * (3 - 2 * fraction)
    return np.clip(across[low] * (1 - smooth) + across[low + 1] * smooth, 0, 1)


def fractal_noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    cells: tuple[int, int],
    *,
    octaves: int = 4,
    persistence: float = 0.5,
) -> np.ndarray:
    """Sum of `value_noise` at doubling frequency, scaled to 0..1."""
    total = np.zeros(shape, np.float32)
    weight, weights = 1.0, 0.0
    for octave in range(octaves):
        scaled = min(cells[0] << octave, shape[0]), min(cells[1] << octave, shape[1])
        total += weight * value_noise(rng, shape, scaled)
        weights += weight
        weight *= persistence
    return total / weights


def coarse_noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    cells: tuple[int, int],
    *,
    persistence: float,
) -> np.ndarray:
    """Four octaves of noise for large images: made four times smaller, then enlarged."""
    small = max(shape[0] // 4, 2), max(shape[1] // 4, 2)
    field = fractal_noise(rng, small, cells, octaves=4, persistence=persistence)
    return cv2.resize(field, shape[::-1], interpolation=cv2.INTER_LINEAR)


def grain(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Independent values about 0 with unit deviation, float32."""
    return rng.standard_normal(shape, dtype=np.float32)


def as_rgba(colour: np.ndarray, fourth: np.ndarray | float = 0.0) -> np.ndarray:
    """RGBA bytes of a float image (height, width, 3) in 0..255 and a channel in 0..1."""
    rgba = np.empty((*colour.shape[:2], 4), np.uint8)
    # a saturating cast that rounds to the nearest, halves to even
    ones: Any = 1.0
    rgba[..., :3] = cv2.multiply(colour, ones, dtype=cv2.CV_8U)
    rgba[..., 3] = np.clip(np.rint(np.asarray(fourth) * 255), 0, 255)
    return rgba
