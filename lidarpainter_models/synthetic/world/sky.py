"""Clouds and the light of the day."""

import numpy as np

from lidarpainter_models.synthetic.plan.layout import StreetPlan
from lidarpainter_models.synthetic.textures.noise import as_rgba, fractal_noise
from lidarpainter_models.synthetic.textures.surfaces import SurfaceSet, srgb_from_linear
from lidarpainter_models.synthetic.world.packing import Light


def draw_clouds(rng: np.random.Generator, *, cover: float) -> np.ndarray:
    """Repeating cloud texture: brightness in the colour, cover in the fourth channel."""
    size = 1024
    shape = fractal_noise(rng, (size, size), (4, 4), octaves=7, persistence=0.55)
    wisps = fractal_noise(rng, (size, size), (3, 12), octaves=6, persistence=0.6)
    density = 0.7 * shape + 0.3 * wisps
    edge = np.quantile(density, 1 - cover)
    opacity = np.clip((density - edge) * 6.0, 0, 1)
    relief = np.roll(density, (9, 5), (0, 1)) - density
    bright = np.clip(0.92 + 2.0 * relief - 0.22 * opacity, 0.45, 1.0)
    colour = srgb_from_linear(bright)[..., None] * 255 * np.array([1.0, 1.0, 1.0])
    return as_rgba(colour, 0.92 * opacity)


def draw_light(surfaces: SurfaceSet, plan: StreetPlan, rng: np.random.Generator) -> Light:
    """A day: how high the sun, how warm its light, how much cloud."""
    clouds = surfaces.add_texture(draw_clouds(rng, cover=rng.uniform(0.3, 0.75)), repeats=True)
    height = plan.sun_direction[2]
    warmth = 1.0 - height
    return Light(
        sun_direction=plan.sun_direction,
        sun_rgb=(2.65, 2.65 * (0.98 - 0.14 * warmth), 2.65 * (0.92 - 0.34 * warmth)),
        haze_per_m=1 / rng.uniform(900, 2400),
        cloud_texture=clouds,
        cloud_offset=(float(rng.random()), float(rng.random())),
    )
