"""What fog and rain do to a sweep: surfaces fade, and the air itself sends light back.

A surface of reflectance rho at range r sends back rho / pi exp(-2 a r) / r^2 of a pulse, fog at
range R b l exp(-2 a R) / R^2, with extinction a, backscatter b = 0.046 / MOR where
MOR = ln(20) / a, and half the length l of a pulse (Rasshofer et al., 2011; Hahner et al., 2021).
The stronger one is reported, if a sensor can tell it at all. Drops of rain stop single rays.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.styling.scene_style import SceneStyle
from lidarpainter_models.weather.air import extinction_per_m, rain_extinction_per_m
from lidarpainter_models.weather.water import (
    DROPS_RETURN_M,
    RAIN_MM_PER_H,
    WETNESS,
    wet_reflectance,
)

BACKSCATTER = 0.046 / math.log(20)
"""Of fog, per steradian, in units of its extinction."""
HALF_PULSE_M = 0.75
"""Half the length of a pulse of 5 ns."""
SEEN_FROM_M = 5.0
"""Fog nearer than this lies beside what the receiver looks at: no data sheet says it."""
DARK = 0.1
"""Reflectance of what a sensor reports as quite dark."""
FAINTEST = DARK / math.pi / 150.0**2
"""A dark surface is just told at 150 m in clear air."""
SURE = 2.0
"""Power of the ratio of two returns with which the odds grow that the stronger is told."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Air:
    """The weather at a moment."""

    fog_per_m: float
    """Extinction by fog."""
    rain_per_m: float
    wetness: float
    """Of surfaces, 0 to 1."""

    @classmethod
    def of(cls, style: SceneStyle | None, time_ns: int) -> "Air | None":
        """The air of a style at a time; None where it is clear. Night changes nothing."""
        strengths = {} if style is None else style.strengths(time_ns)
        fog, rain = strengths.get("foggy", 0.0), strengths.get("rain", 0.0)
        if style is None or not (fog or rain):
            return None
        return cls(
            fog_per_m=fog * extinction_per_m(style.mix.visibility_m),
            rain_per_m=rain * rain_extinction_per_m(RAIN_MM_PER_H),
            wetness=rain * WETNESS,
        )

    def dimmed(
        self,
        range_m: Float[Tensor, " rays"],
        intensity: Float[Tensor, " rays"],
        lost: Float[Tensor, " rays"],
    ) -> tuple[Float[Tensor, " rays"], Float[Tensor, " rays"]]:
        """Intensity as a sensor reports it through the air, and the chance of being lost."""
        through = torch.exp(-2 * (self.fog_per_m + self.rain_per_m) * range_m)
        clear = Air(fog_per_m=0.0, rain_per_m=0.0, wetness=0.0).power(range_m, intensity)
        kept = _told(self.power(range_m, intensity), FAINTEST) / _told(clear, FAINTEST)
        seen = through * wet_reflectance(intensity, self.wetness)
        return seen, 1 - (1 - lost) * kept.clamp(max=1)

    def power(
        self, range_m: Float[Tensor, " rays"], intensity: Float[Tensor, " rays"]
    ) -> Float[Tensor, " rays"]:
        """What comes back of a surface through the air, per steradian and square metre."""
        reflectance = DARK + (1 - DARK) * wet_reflectance(intensity, self.wetness)
        through = torch.exp(-2 * (self.fog_per_m + self.rain_per_m) * range_m)
        return through * reflectance / math.pi / range_m.clamp(min=SEEN_FROM_M) ** 2

    def clutter_m(
        self,
        range_m: Float[Tensor, " rays"],
        intensity: Float[Tensor, " rays"],
        random: torch.Generator | None,
    ) -> Float[Tensor, " rays"]:
        """Where the air sends a ray back before the surface that it would meet; inf: nowhere.

        Args:
            range_m: of the surface, inf where there is none.
            intensity: of the surface in clear air, 0 to 1.
            random: draws it; None takes what is likelier.
        """
        chance, place = (
            torch.full((2, len(range_m)), 0.5)
            if random is None
            else torch.rand((2, len(range_m)), generator=random)
        )
        fog = BACKSCATTER * self.fog_per_m * HALF_PULSE_M / SEEN_FROM_M**2
        fog *= math.exp(-2 * self.fog_per_m * SEEN_FROM_M)
        against = self.power(range_m, intensity) + FAINTEST
        is_fog = (chance < _told(torch.full_like(range_m, fog), against)) & (range_m > SEEN_FROM_M)
        fog_m = 1 / (1 / SEEN_FROM_M - place * (1 / SEEN_FROM_M - 1 / range_m))
        found = torch.where(is_fog, fog_m, torch.inf)
        reach_m = range_m.clamp(max=DROPS_RETURN_M)
        is_drop = chance > torch.exp(-self.rain_per_m * reach_m)
        return torch.where(is_drop, torch.minimum(found, place * reach_m), found)


def _told(power: Tensor, against: Tensor | float) -> Tensor:
    """Chance that one return is told rather than another, or rather than nothing."""
    odds = (power / against) ** SURE
    return odds / (1 + odds)
