"""Which directions the texels of a sky texture stand for, and where a camera's rays meet them.

A texture covers a patch of the sphere of directions in equal steps of azimuth and elevation.
World frame: z up; azimuth is measured from x towards y, so columns run from left to right with
falling azimuth, rows from top to bottom with falling elevation. Angles are radians.
"""

import math
from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class SkyLayout:
    """Which directions the texels of a sky texture stand for."""

    azimuth_left_rad: float
    elevation_top_rad: float
    texel_rad: float
    columns: int
    rows: int

    @property
    def wraps(self) -> bool:
        """Whether the texture runs all the way round, so that its sides meet."""
        return self.columns * self.texel_rad > 2 * math.pi - 0.5 * self.texel_rad


@dataclass(frozen=True, kw_only=True, eq=False)
class SkyRays:
    """Where the rays of a camera meet a sky texture."""

    places: Float[Tensor, "height width 2"]
    """Continuous (column, row), texel centres at +0.5; of pixels not wanted, anything."""
    wanted: Bool[Tensor, "height width"]
    """Pixels whose sky colour matters."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TexelMoments:
    """Adam's moments of every texel, and how many steps it took; changed in place."""

    first: Float[Tensor, "rows columns 3"]
    second: Float[Tensor, "rows columns 3"]
    visits: Int[Tensor, "rows columns"]
