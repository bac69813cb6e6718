"""What decides which views are painted and what a painter is shown; read without tensors."""

from dataclasses import dataclass, field, replace
from math import copysign, radians
from typing import Literal

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.shifts import MAX_SHIFT_M, Shift


@dataclass(frozen=True, slots=True, kw_only=True)
class ConditionConfig:
    """What is gathered for a painter."""

    num_references: int = 2
    """Warped references given to the painter."""
    num_sources: int = 6
    """Recorded images they are patched together from: the nearest, then ever sparser ones."""

    def __post_init__(self) -> None:
        if not 1 <= self.num_references <= self.num_sources:
            raise ConfigError(
                f"need 1 <= num_references <= num_sources, got {self.num_references} and "
                f"{self.num_sources}"
            )


PreviousUse = Literal["unused", "mixed", "shown"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SequenceConfig:
    """What becomes of the frame painted before."""

    previous: PreviousUse = "unused"
    """`mixed`: into the painting, as far as both agree; `shown`: to the painter, before the other
    warped images, of which it was trained to expect recorded ones only."""


PAPER_SHIFTS = (
    Shift(lateral_m=2.0),
    Shift(lateral_m=-2.0),
    Shift(lateral_m=3.0),
    Shift(lateral_m=-3.0),
    Shift(up_m=1.5),
)
DEFAULT_SHIFTS = (*PAPER_SHIFTS, Shift(yaw_rad=radians(40)), Shift(yaw_rad=-radians(40)))


@dataclass(frozen=True, slots=True, kw_only=True)
class NovelGuidanceConfig:
    """Which views are painted and what becomes of them."""

    shifts: tuple[Shift, ...] = DEFAULT_SHIFTS
    """Where the recorded cameras are moved to: the paper's 2 and 3 m to both sides and 1.5 m up;
    where no camera of the rig looks they are turned by 40 degrees to both sides as well
    (docs/decisions/what-guides-a-fit.md)."""
    outwards_m: float = 0.0
    """How much farther to the side each round paints than the one before; with 0 rounds share the
    distances to the side among them."""
    every_nth: int = 2
    """Of the training frames, every n-th is painted at every shift."""
    camera_names: tuple[str, ...] | None = None
    """Cameras that are moved; None moves every training camera."""
    sequence: SequenceConfig = field(default_factory=SequenceConfig)
    """What becomes of the frame painted before along the same path."""

    def __post_init__(self) -> None:
        if not self.shifts:
            raise ConfigError("novel guidance needs at least one shift")
        if self.every_nth < 1:
            raise ConfigError(f"every_nth must be at least 1, got {self.every_nth}")
        if not 0 <= self.outwards_m <= MAX_SHIFT_M:
            raise ConfigError(
                f"novel.outwards_m must lie between 0 and {MAX_SHIFT_M:g} metres, got "
                f"{self.outwards_m}"
            )

    def in_round(self, number: int, rounds: int) -> "NovelGuidanceConfig":
        """What is painted in one of so many rounds, of which the first is 1.

        Each distance to the side is painted in one of them, the nearest first: to paint all of them
        in each round took two thirds more time and gave nothing. What is not aside is painted in
        all rounds.

        Raises:
            ConfigError: that is farther away than a scene shows anything.
        """
        if self.outwards_m == 0:
            return replace(self, shifts=self._of_round(number, rounds))
        farther_m = self.outwards_m * (number - 1)
        try:
            shifts = tuple(
                replace(one, lateral_m=one.lateral_m + copysign(farther_m, one.lateral_m))
                if one.lateral_m
                else one
                for one in self.shifts
            )
        except ConfigError as error:
            raise ConfigError(f"novel.outwards_m in round {number}: {error}") from None
        return replace(self, shifts=shifts, outwards_m=0.0)

    def _of_round(self, number: int, rounds: int) -> tuple[Shift, ...]:
        away_m = sorted({abs(shift.lateral_m) for shift in self.shifts if shift.lateral_m})
        turns = max(min(rounds, len(away_m)), 1)
        own_m = (0.0, *away_m[(number - 1) % turns :: turns])
        return tuple(shift for shift in self.shifts if abs(shift.lateral_m) in own_m)
