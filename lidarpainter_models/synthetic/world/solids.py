"""Simple solids added to a mesh: boxes, tubes, rounded posts."""

import numpy as np

from lidarpainter_models.synthetic.world.meshes import MeshBuilder, Vector


def add_box(
    builder: MeshBuilder,
    centre: Vector,
    size: Vector,
    surface: int,
    *,
    yaw_rad: float = 0.0,
    faces: dict[str, int] | None = None,
) -> None:
    """An upright box; `faces` gives single faces another surface.

    Front looks along +x, left along +y. Each face shows its whole texture upright.
    """
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    axis_x = np.array([cosine, sine, 0.0]) * size[0]
    axis_y = np.array([-sine, cosine, 0.0]) * size[1]
    axis_z = np.array([0.0, 0.0, 1.0]) * size[2]
    half = (axis_x + axis_y + axis_z) / 2
    low, high = np.asarray(centre) - half, np.asarray(centre) + half
    # corner at the upper left as seen from outside, then along the texture's rows, then down
    layout = {
        "front": (low + axis_x + axis_z, axis_y, -axis_z),
        "back": (low + axis_y + axis_z, -axis_y, -axis_z),
        "left": (high, -axis_x, -axis_z),
        "right": (low + axis_z, axis_x, -axis_z),
        "top": (low + axis_y + axis_z, -axis_y, axis_x),
        "bottom": (low, axis_x, axis_y),
    }
    for face, (corner, first, second) in layout.items():
        builder.quad(corner, first, second, (faces or {}).get(face, surface))


def add_tube(
    builder: MeshBuilder,
    start: Vector,
    end: Vector,
    radii: tuple[float, float],
    surface: int,
    *,
    sides: int = 10,
    has_caps: bool = False,
) -> None:
    """A round tube (or cone) between two points, smooth around; texture v runs from its end."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    axis = end - start
    axis = axis / np.linalg.norm(axis)
    helper = np.array([1.0, 0, 0]) if abs(axis[2]) > 0.9 else np.array([0, 0, 1.0])
    first = np.cross(helper, axis)
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    angles = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    low, high = start + radii[0] * ring, end + radii[1] * ring
    turn = np.linspace(0, 1, sides + 1)
    zeros, ones = np.zeros_like(turn), np.ones_like(turn)
    builder.grid(
        np.stack([low, high]),
        np.stack([np.stack([turn, ones], -1), np.stack([turn, zeros], -1)]),
        surface,
        normals=np.stack([ring, ring]),
    )
    if has_caps:
        _add_cap(builder, end, high, surface)
        _add_cap(builder, start, low, surface)


def _add_cap(builder: MeshBuilder, centre: np.ndarray, rim: np.ndarray, surface: int) -> None:
    """A disc as a fan of triangles."""
    count = rim.shape[0] - 1
    corners = np.stack([np.repeat(centre[None], count, 0), rim[:-1], rim[1:]], axis=1)
    builder.primitives(corners, np.full((count, 3, 2), 0.5), surface)


def add_ball(
    builder: MeshBuilder, centre: Vector, radii: Vector, surface: int, *, rows: int = 6
) -> None:
    """An ellipsoid, of ten columns."""
    lines = np.linspace(0, np.pi, rows + 1)[:, None]
    turns = np.linspace(0, 2 * np.pi, 11)[None, :]
    unit = np.stack(
        [np.sin(lines) * np.cos(turns), np.sin(lines) * np.sin(turns), np.cos(lines) + 0 * turns],
        axis=-1,
    )
    points = np.asarray(centre) + unit * np.asarray(radii)
    normals = unit / np.asarray(radii)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    uv = np.stack(np.broadcast_arrays(turns / (2 * np.pi), lines / np.pi), axis=-1)
    builder.grid(points, uv, surface, normals=normals)
