"""The LiDAR of the street: beams, timing, noise and lost returns on top of the traced ranges."""

import numpy as np

from lidarpainter_models.synthetic.config import RigLidar

GLASS_GLOSS = 0.8
BRIGHTNESS_REACH_M = 58.0
"""Where a matt white surface met head-on is lost half of the time, halved by the law below."""
FLOOR_BRIGHTNESS = 0.06


def beam_inclinations_rad(beams: int) -> np.ndarray:
    """Inclinations of a Hesai Pandar64, upper beam first; `beams` of them, evenly chosen.

    They are 0.167 degrees apart from +2 to -6 degrees and coarser above and below (Hesai Pandar64
    user's manual, channel distribution).
    """
    upper = [15.0, 11.0, 8.0, 5.0, 3.0]
    middle = 2.0 - np.arange(49) / 6.0
    lower = [-7.0, -8.0, -9.0, -10.0, -11.0, -12.0, -13.0, -14.0, -19.0, -25.0]
    degrees = np.concatenate([upper, middle, lower])
    chosen = np.unique(np.linspace(0, degrees.size - 1, beams).round().astype(int))
    return np.deg2rad(degrees[chosen])


def firings(lidar: RigLidar, turn_s: float) -> tuple[np.ndarray, np.ndarray]:
    """When each column of a turn is fired, from its middle, and where to; both (columns).

    Azimuths are counter-clockwise from ahead; the turn goes clockwise, ahead comes in its middle.
    """
    share = (np.arange(lidar.columns) + 0.5) / lidar.columns
    return (share - 0.5) * turn_s, np.pi - 2 * np.pi * share


def returns_mask(
    range_m: np.ndarray, surface: np.ndarray, lidar: RigLidar, rng: np.random.Generator
) -> np.ndarray:
    """Which rays come back: bright, near and met head-on ones mostly, through panes seldom.

    Ranges are (columns, beams), inf for no hit; `surface` (columns, beams, 3) is brightness, gloss
    and cosine of incidence. Three numbers are drawn per ray.
    """
    bright, gloss, cosine = (surface[..., i].astype(float) for i in range(3))
    energy = (bright + FLOOR_BRIGHTNESS) * np.maximum(cosine, 0.0) ** 0.75
    strength = energy * (BRIGHTNESS_REACH_M / np.maximum(range_m, 1.0)) ** 2 * 8.0
    chance = 1.0 - np.exp(-strength)
    chance *= np.where(gloss > GLASS_GLOSS, 1.0 - lidar.glass_dropout, 1.0)
    draws = rng.random(range_m.shape)
    is_lost = rng.random(range_m.shape) < lidar.dropout
    return (range_m >= lidar.min_range_m) & np.isfinite(range_m) & (draws < chance) & ~is_lost


def intensities(surface: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What the sensor reports, 0..255: brightness times slant, with 5 % noise."""
    value = 255 * (surface[..., 0] + 0.02) * np.maximum(surface[..., 2], 0.0) ** 0.5
    value = value * (1 + 0.05 * rng.standard_normal(value.shape))
    return np.clip(np.rint(value), 0, 255).astype(np.float32)
