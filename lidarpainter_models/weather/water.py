"""Wet surfaces: darker, mirroring, with puddles that stay where they are.

Water between the grains of asphalt sends light back inside, so wet surfaces are darker and more
strongly coloured (Lekner and Dorf, 1988). The film on top mirrors its surroundings as much as
Fresnel's equations say of water (n = 1.33; Schlick's form, 1994).
"""

import math

import torch
from jaxtyping import Float
from torch import Generator, Tensor

WATER_REFLECTANCE = 0.02
"""Of water seen from straight above: ((1.33 - 1) / (1.33 + 1))^2."""
WET_POWER = 1.5
"""Reflectance r of a dry surface becomes about r to this when wet."""
FILM_SHINE = 0.55
"""Of a thin film against a puddle, whose surface is whole."""
PUDDLE_SIZE_M = 3.0
PUDDLE_SHARE = 0.35
"""Part of the road where water stands still and mirrors clearly."""
WETNESS = 0.8
"""How far surfaces darken like wet ones; the road wholly, walls half as much."""
RAIN_MM_PER_H = 25.0
"""Heavy rain."""
DROPS_RETURN_M = 12.0
"""Rain and spray send a LiDAR's light back from up to this distance."""


def wet_reflectance(reflectance: Float[Tensor, "*grid"], wetness: float) -> Float[Tensor, "*grid"]:
    """Dry reflectance r turned to r^1.5 as far as it is wet."""
    return reflectance + wetness * (reflectance.clamp_min(0) ** WET_POWER - reflectance)


def fresnel(cosine: Float[Tensor, "*grid"]) -> Float[Tensor, "*grid"]:
    """Share of light that water mirrors, by the cosine to its normal."""
    return WATER_REFLECTANCE + (1 - WATER_REFLECTANCE) * (1 - cosine.clamp(0, 1)) ** 5


def puddles(
    points_m: Float[Tensor, "*grid 3"], generator: Generator, *, share: float
) -> Float[Tensor, "*grid"]:
    """How still the water stands on the ground, in [0, 1]: smooth noise fixed to the place."""
    value = torch.zeros_like(points_m[..., 0])
    for _ in range(6):
        drawn = torch.rand(3, generator=generator)
        angle, phase = 2 * math.pi * drawn[0], 2 * math.pi * drawn[1]
        wave = 2 * math.pi / (PUDDLE_SIZE_M * (0.5 + 1.5 * drawn[2]))
        along = points_m[..., 0] * angle.cos() + points_m[..., 1] * angle.sin()
        value += torch.sin(wave * along + phase)
    level = math.sqrt(6 / 2) * math.sqrt(2) * torch.erfinv(torch.tensor(1 - 2 * share))
    return torch.sigmoid(3 * (value - level))
