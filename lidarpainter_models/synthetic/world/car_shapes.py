"""Bodies of cars as lofted shells with wheels, in their box frames.

A body is a row of cross-sections from tail to nose, each a ring from sill over roof to sill. Every
face takes its texture from the side, front, rear or top view it looks towards.
"""

import numpy as np

from lidarpainter_models.synthetic.plan.car_kinds import CarShape
from lidarpainter_models.synthetic.textures.cars import CarAtlas
from lidarpainter_models.synthetic.world.meshes import Mesh, MeshBuilder, cell_corners
from lidarpainter_models.synthetic.world.solids import add_box, add_tube

LOWEST_M = 0.24
BULGE = ((0.955, 0.05), (0.87, 0.082), (0.6, 0.1), (0.25, 0.105), (0.0, 0.105))
"""How the ends are closed: rings shrunk to a share, pushed out by metres."""


def build_car(shape: CarShape, atlas: CarAtlas, num_stations: int = 34) -> tuple[Mesh, np.ndarray]:
    """The mesh of a car in its box frame (origin at the box's centre) and the box's size."""
    builder = MeshBuilder()
    _add_shell(builder, shape, atlas, num_stations)
    _add_wheels(builder, shape, atlas)
    _add_trim(builder, shape, atlas)
    mesh = builder.build()
    corners = mesh.corners().reshape(-1, 3)
    low, high = corners.min(0), corners.max(0)
    shift = np.eye(4)
    shift[:3, 3] = -(low + high) / 2
    return mesh.transformed(shift), high - low


def _half_width(shape: CarShape, x: np.ndarray) -> np.ndarray:
    """Plan of the body: round at nose and tail."""
    end = np.clip((np.abs(x) - (shape.length_m / 2 - 0.75)) / 0.75, 0, 1)
    return shape.width_m / 2 * (1 - 0.2 * end**2.2)


def _rings(shape: CarShape, stations: np.ndarray) -> np.ndarray:
    """Points (stations, ring, 3) from the left sill over the roof to the right sill."""
    top = np.interp(stations, *np.transpose(shape.roof))
    belt = np.minimum(np.interp(stations, *np.transpose(shape.belt)), top - 0.02)
    width = _half_width(shape, stations)
    cabin = np.clip((top - belt - 0.1) / 0.35, 0, 1)
    roof_width = width * (0.93 - 0.2 * cabin)
    belt_width = width * 0.955
    middle = LOWEST_M + 0.55 * (belt - LOWEST_M)
    crown = 0.02 + 0.03 * cabin
    half = [
        (width * 0.80, np.full_like(top, LOWEST_M)),
        (width * 0.965, np.full_like(top, LOWEST_M + 0.07)),
        (width * 1.0, middle),
        (width * 0.99, middle + 0.75 * (belt - middle)),
        (belt_width, belt),
        (0.55 * belt_width + 0.45 * roof_width, belt + 0.5 * (top - crown - belt)),
        (roof_width, top - crown),
        (roof_width * 0.86, top - 0.4 * crown),
        (roof_width * 0.45, top - 0.05 * crown),
        (roof_width * 0.0, top),
    ]
    left = [np.stack([stations, y, z], axis=-1) for y, z in half]
    right = [point * np.array([1, -1, 1]) for point in left[-2::-1]]
    return np.stack([*left, *right], axis=1)


def _closed(rings: np.ndarray) -> np.ndarray:
    """The rings with rounded ends, shrunk towards the middle of the floor."""
    ends = []
    for ring, out in ((rings[0], -1.0), (rings[-1], 1.0)):
        centre = np.array([ring[0, 0], 0.0, LOWEST_M])
        shrunk = [
            centre + (ring - centre) * [1.0, share, share] + [out * push, 0.0, 0.0]
            for share, push in BULGE
        ]
        ends.append(np.stack(shrunk))
    return np.concatenate([ends[0][::-1], rings, ends[1]])


def _add_shell(builder: MeshBuilder, shape: CarShape, atlas: CarAtlas, num_stations: int) -> None:
    """The body between the two ends, the ends, and the floor."""
    half = shape.length_m / 2 - BULGE[-1][1]
    even = np.linspace(-half, half, num_stations)
    bends = [x for x, _ in shape.roof if abs(x) < half]
    stations = np.unique(np.concatenate([even, bends, shape.glass]))
    keep = np.concatenate([[True], np.diff(stations) > 0.02])
    rings = _closed(_rings(shape, stations[keep]))
    normals = _smooth_normals(rings)
    for order in ((0, 3, 1), (2, 1, 3)):
        corners, smooth = cell_corners(rings, order), cell_corners(normals, order)
        builder.primitives(corners, atlas.uv(corners), atlas.body, normals=smooth)
    floor = np.stack([rings[:, 0], rings[:, -1]])
    builder.grid(floor, np.full((*floor.shape[:2], 2), 0.5), atlas.rubber)


def _smooth_normals(rings: np.ndarray) -> np.ndarray:
    """Normals of a shell at its points, outward."""
    along, around = np.gradient(rings, axis=0), np.gradient(rings, axis=1)
    normals = np.cross(along, around)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    centre = np.array([0.0, 0.0, 0.6])
    is_inward = ((rings - centre) * normals).sum(-1) < 0
    return np.where(is_inward[..., None], -normals, normals)


def _add_wheels(builder: MeshBuilder, shape: CarShape, atlas: CarAtlas) -> None:
    """Four tyres with rims; their bottoms stand on z = 0."""
    radius = shape.wheel_radius_m
    for x in shape.wheel_x_m:
        width = float(_half_width(shape, np.array([x]))[0])
        for side in (-1.0, 1.0):
            outer = np.array([x, side * (width + 0.012), radius])
            inner = np.array([x, side * (width - 0.22), radius])
            add_tube(builder, inner, outer, (radius, radius), atlas.rubber, sides=20)
            corner = outer + np.array([-radius, side * 0.002, radius])
            down = np.array([0, 0, -2 * radius])
            builder.quad(corner, np.array([2 * radius, 0, 0]), down, atlas.rim)


def _add_trim(builder: MeshBuilder, shape: CarShape, atlas: CarAtlas) -> None:
    """Mirrors, door handles and licence plates."""
    x = shape.glass[3] - 0.22
    belt = float(np.interp(x, *np.transpose(shape.belt)))
    width = float(_half_width(shape, np.array([x]))[0])
    for side in (-1.0, 1.0):
        centre = (x, side * (width + 0.0), belt + 0.07)
        add_box(builder, centre, (0.1, 0.16, 0.13), atlas.paint)
        for handle in shape.pillars[-2:]:
            height = float(np.interp(handle, *np.transpose(shape.belt))) - 0.13
            add_box(builder, (handle + 0.2, side * width, height), (0.2, 0.05, 0.03), atlas.chrome)
    half = shape.length_m / 2
    for end, face in ((-half - 0.012, "back"), (half + 0.012, "front")):
        height = 0.62 if face == "back" else 0.42
        faces = {face: atlas.plate}
        add_box(builder, (end, 0.0, height), (0.02, 0.5, 0.15), atlas.rubber, faces=faces)
