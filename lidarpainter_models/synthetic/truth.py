"""What a synthetic street tells of itself: true images, actors, lamps and sweeps of the LiDAR.

World: x forward, y left, z up. Boxes: x ahead, y left, z up, origin at the centre. Metres.
"""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.scenes.records import SweepPoints


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueImage:
    """What is really there: free of noise, at exposure 1."""

    rgb: Float[Tensor, "height width 3"]
    depth_m: Float[Tensor, "height width"]
    """Camera z on the ray through the pixel centre; 0 in the sky."""
    semantics: Int[Tensor, "height width"]
    """`StreetClass` at the pixel centre."""
    actor_index: Int[Tensor, "height width"]
    """Index in `SyntheticStreet.actors` at the pixel centre, -1 for none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ActorState:
    """One actor at one time."""

    actor_id: str
    category: str
    is_moving: bool
    size_m: tuple[float, float, float]
    """Length, width, height."""
    world_from_box: Float[Tensor, "4 4"]


@dataclass(frozen=True, kw_only=True, eq=False)
class LensState:
    """One lens of a lamp that switches, at one time."""

    actor_index: int
    """Index in `SyntheticStreet.actors`, -1 for the street."""
    centre_m: Float[Tensor, " 3"]
    """Centre of the upright box around the lens, float64: in the actor's box frame or the world."""
    size_m: Float[Tensor, " 3"]
    """Size of that box along its frame's axes, float64."""
    is_lit: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedSweep:
    """One turn of the LiDAR."""

    timestamp_ns: int
    world_from_lidar: Float[Tensor, "4 4"]
    points: SweepPoints
    semantics: Int[Tensor, " points"]
    actor_index: Int[Tensor, " points"]
    """Index in `SyntheticStreet.actors`, -1 for none."""
