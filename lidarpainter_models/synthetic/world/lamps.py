"""Lamps that go on and off while a street is recorded: signals that change, cars that brake.

A lamp is one switch; the lenses that show it are places in the world or in the box frame of a car.
Times are seconds after the first frame. Lamps switch at once, without a glow.
"""

from dataclasses import dataclass, field

import numpy as np

from lidarpainter_models.synthetic.world.meshes import Mesh

SIGNAL_CHANGE_S = (0.6, 1.4)
BRAKING_S = (0.6, 1.2)
BETWEEN_S = 0.4
"""Least time without braking before and after each braking."""
FIRST_BRAKED_S = 2.1
"""Time by which every driver has braked once."""


@dataclass(frozen=True, slots=True)
class Switching:
    """The course of one lamp."""

    is_lit_first: bool
    times_s: tuple[float, ...]
    """When it goes on or off, ascending."""

    def is_lit(self, time_s: np.ndarray) -> np.ndarray:
        """Whether it is on, bool (times); at the instant of a switch the new state holds."""
        num_switches = np.searchsorted(np.array(self.times_s), time_s, side="right")
        return (num_switches % 2 == 1) != self.is_lit_first


@dataclass(frozen=True, eq=False)
class Lens:
    """A glass that shows a lamp, as the upright box around it."""

    lamp: int
    """Column of `SwitchingLamps.is_lit`."""
    centre_m: np.ndarray
    """float64 (3), in the world or in the box frame of its actor."""
    size_m: np.ndarray
    """float64 (3), along the axes of that frame."""

    @classmethod
    def of_mesh(cls, lamp: int, mesh: Mesh) -> "Lens":
        """The box around a mesh."""
        corners = mesh.corners().reshape(-1, 3)
        low, high = corners.min(0), corners.max(0)
        return cls(lamp, (low + high) / 2, high - low)


@dataclass(eq=False)
class SwitchingLamps:
    """All lamps of a street that switch, each kind with its own stream; none without streams."""

    signal_rng: np.random.Generator | None = None
    brake_rng: np.random.Generator | None = None
    switchings: list[Switching] = field(default_factory=list)
    standing: list[Lens] = field(default_factory=list)
    """Lenses of the street, in the world; those of cars are with the cars."""

    def add_signals(self) -> dict[str, int]:
        """Draw when the signals of the street change; the lamp of each colour that does."""
        if self.signal_rng is None:
            return {}
        change_s = (self.signal_rng.uniform(*SIGNAL_CHANGE_S),)
        is_green_first = bool(self.signal_rng.random() < 0.5)
        return {
            "red": self._add(Switching(not is_green_first, change_s)),
            "green": self._add(Switching(is_green_first, change_s)),
        }

    def add_brakes(self) -> int:
        """Draw when a car brakes, once or twice; its lamp, -1 where no lamp switches."""
        rng = self.brake_rng
        if rng is None:
            return -1
        lasting, again = rng.uniform(*BRAKING_S), rng.uniform(*BRAKING_S)
        start = rng.uniform(BETWEEN_S, FIRST_BRAKED_S - lasting)
        pause = rng.uniform(BETWEEN_S, 3 * BETWEEN_S)
        end = start + lasting
        times_s = (start, end, end + pause, end + pause + again)
        brakes_twice = rng.random() < 0.5
        return self._add(Switching(False, times_s if brakes_twice else times_s[:2]))

    def _add(self, switching: Switching) -> int:
        self.switchings.append(switching)
        return len(self.switchings) - 1

    def is_lit(self, time_s: np.ndarray) -> np.ndarray:
        """float32 (times, lamps): 1 where a lamp is on at a time, 0 where it is off."""
        lit = [switching.is_lit(time_s) for switching in self.switchings]
        return np.array(lit, np.float32).reshape(len(lit), time_s.size).T.copy()
