"""Brake lamps of cars: two curved lenses that stand out of the bodywork at the rear.

Everything is in the box frame of the car: x ahead, y left, z up, origin at the centre, metres.
"""

import numpy as np

from lidarpainter_models.synthetic.plan.car_kinds import CarShape
from lidarpainter_models.synthetic.textures.surfaces import StreetClass, SurfaceSet
from lidarpainter_models.synthetic.world.lamps import Lens
from lidarpainter_models.synthetic.world.meshes import Mesh, MeshBuilder

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
