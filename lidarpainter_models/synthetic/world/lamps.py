"""Lamps that go on and off while a street is recorded: signals that change, cars that brake.

A lamp is one switch; the lenses that show it are places in the world or in the box frame of a car.
Times are seconds after the first frame. Lamps switch at once, without a glow.
"""

from dataclasses import dataclass, field

import numpy as np

from lidarpainter_models.synthetic.plan.car_kinds import CarShape
from lidarpainter_models.synthetic.textures.surfaces import StreetClass, SurfaceSet
from lidarpainter_models.synthetic.world.meshes import Mesh, MeshBuilder

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


WIDTH_M, HEIGHT_M = 0.2, 0.14
PROUD_M = 0.012
"""How far a lens stands out of the bodywork."""
RIM_M = 0.03
"""How deep its rim reaches, back into the bodywork."""
OUTER_SHARE = 0.76
"""Share of a car's half width at which a lens ends: beyond, the body turns to its side."""
ABOVE_BELT_M = 0.01
"""Top of a lens above the foot of the rear window, where the painted lamps end too."""
BELOW_ROOF_M = 0.1
RED = (122, 10, 12)
EMISSION = 8.0
ROWS, COLUMNS = 3, 6


def with_brake_lenses(
    mesh: Mesh, size_m: np.ndarray, shape: CarShape, surfaces: SurfaceSet, lamp: int
) -> tuple[Mesh, tuple[Lens, ...]]:
    """A car's mesh with a left and a right lens of one lamp, and where they are.

    They are of dark red glass that the lamp makes bright.
    The mesh is that of `build_car`, `size_m` (3) its box: lenses keep inside.
    """
    surface = surfaces.plain(RED, StreetClass.CAR, gloss=0.5, emission=EMISSION, lamp=lamp)
    tail = -shape.length_m / 2 + 0.15
    belt = float(np.interp(tail, *np.transpose(shape.belt)))
    roof = float(np.interp(tail, *np.transpose(shape.roof)))
    top = min(belt + ABOVE_BELT_M, roof - BELOW_ROOF_M) - size_m[2] / 2
    outer = OUTER_SHARE * shape.width_m / 2
    meshes, lenses = [mesh], []
    for side in (1.0, -1.0):
        across = side * np.linspace(outer, outer - WIDTH_M, COLUMNS)
        lens = _lens_mesh(mesh, across, np.linspace(top, top - HEIGHT_M, ROWS), surface)
        meshes.append(lens)
        lenses.append(Lens.of_mesh(lamp, lens))
    return Mesh.joined(meshes), tuple(lenses)


def _lens_mesh(mesh: Mesh, across: np.ndarray, up: np.ndarray, surface: int) -> Mesh:
    """A sheet that follows the rear of a mesh over places (columns) and (rows), with a rim."""
    y, z = np.meshgrid(across, up)
    x = _rear_x(mesh, np.stack([y.ravel(), z.ravel()], axis=-1)).reshape(y.shape) - PROUD_M
    sheet = np.stack([x, y, z], axis=-1)
    border = np.concatenate([sheet[0], sheet[1:, -1], sheet[-1, -2::-1], sheet[-2::-1, 0]])
    rim = np.stack([border, border + np.array([RIM_M, 0.0, 0.0])])
    builder = MeshBuilder()
    for points, is_smooth in ((sheet, True), (rim, False)):
        builder.grid(points, np.zeros((*points.shape[:2], 2)), surface, is_smooth=is_smooth)
    return builder.build()


def _rear_x(mesh: Mesh, places: np.ndarray) -> np.ndarray:
    """Where lines along x at y, z (places, 2) first meet a mesh from behind: x (places)."""
    corner, first, second = (mesh.geometry[None, :, i : i + 3] for i in (0, 3, 6))
    y, z = places[:, :1] - corner[..., 1], places[:, 1:] - corner[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):  # seen edge-on, never met
        scale = 1.0 / (first[..., 1] * second[..., 2] - first[..., 2] * second[..., 1])
        u = (y * second[..., 2] - z * second[..., 1]) * scale
        v = (first[..., 1] * z - first[..., 2] * y) * scale
        x = corner[..., 0] + u * first[..., 0] + v * second[..., 0]
        is_met = (u >= 0) & (v >= 0) & (u + v <= 1)
    return np.where(is_met, x, np.inf).min(axis=1)
