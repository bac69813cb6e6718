"""Build meshes out of parallelograms and triangles, with surfaces and texture coordinates.

A mesh lives in its own frame, metres; normals may differ at the corners for smooth shading.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from lidarpainter_models.synthetic.raytracing.scene_arrays import (
    GEOMETRY_COLUMNS,
    IS_PARALLELOGRAM,
    SHADING_COLUMNS,
    UV_CORNER,
)

Vector = Sequence[float] | np.ndarray


@dataclass(eq=False)
class Mesh:
    """Primitives as rows: a corner, two edges, what lies there."""

    geometry: np.ndarray
    """float64 (primitives, GEOMETRY_COLUMNS), see scene_arrays.py; cut-outs are marked later."""
    shading: np.ndarray
    """float64 (primitives, SHADING_COLUMNS)."""
    surface: np.ndarray
    """int32 (primitives)."""

    def transformed(self, target_from_mesh: np.ndarray) -> "Mesh":
        """The mesh under a 4x4 transform: a rotation, perhaps scaled, and a translation."""
        linear, offset = target_from_mesh[:3, :3], target_from_mesh[:3, 3]
        geometry, shading = self.geometry.copy(), self.shading.copy()
        geometry[:, 0:3] = geometry[:, 0:3] @ linear.T + offset
        for start in (3, 6):
            geometry[:, start : start + 3] = geometry[:, start : start + 3] @ linear.T
        for start in (0, 3, 6):
            shading[:, start : start + 3] = shading[:, start : start + 3] @ linear.T
        return Mesh(geometry, shading, self.surface)

    @classmethod
    def joined(cls, meshes: Sequence["Mesh"]) -> "Mesh":
        """All primitives of several meshes, in order."""
        geometry, shading = np.zeros((0, GEOMETRY_COLUMNS)), np.zeros((0, SHADING_COLUMNS))
        return cls(
            np.concatenate([geometry, *(mesh.geometry for mesh in meshes)]),
            np.concatenate([shading, *(mesh.shading for mesh in meshes)]),
            np.concatenate([np.zeros(0, np.int32), *(mesh.surface for mesh in meshes)]),
        )

    def corners(self) -> np.ndarray:
        """(primitives, 4, 3): the corners; of a triangle the last one comes twice."""
        corner, first, second = self.geometry[:, 0:3], self.geometry[:, 3:6], self.geometry[:, 6:9]
        both = np.where(self.geometry[:, IS_PARALLELOGRAM, None] > 0, first + second, second)
        return np.stack([corner, corner + first, corner + second, corner + both], axis=1)


UNIT_UV = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))


@dataclass(eq=False)
class MeshBuilder:
    """Collects primitives; `build` gives the mesh."""

    parts: list[Mesh] = field(default_factory=list)

    def build(self) -> Mesh:
        """All that was added."""
        return Mesh.joined(self.parts)

    def add(self, mesh: Mesh) -> None:
        """Append another mesh of the same frame."""
        self.parts.append(mesh)

    def quad(
        self,
        corner: Vector,
        first: Vector,
        second: Vector,
        surface: int,
        *,
        uv: Sequence[Sequence[float]] = UNIT_UV,
    ) -> None:
        """A parallelogram; `uv` at the corner, past the first edge, past the second edge."""
        corners = np.array([corner, np.add(corner, first), np.add(corner, second)], float)
        self.primitives(corners[None], np.array(uv, float)[None], surface, is_parallelogram=True)

    def primitives(
        self,
        corners: np.ndarray,
        uv: np.ndarray,
        surface: int | np.ndarray,
        *,
        normals: np.ndarray | None = None,
        is_parallelogram: bool = False,
    ) -> None:
        """Many primitives by three corners each.

        Corners (primitives, 3, 3) are the corner, past the first edge, past the second edge; `uv`
        (primitives, 3, 2) and `normals`, flat where absent, alike. A parallelogram spans the fourth
        corner too.
        """
        count = corners.shape[0]
        geometry = np.zeros((count, GEOMETRY_COLUMNS))
        geometry[:, :9] = _with_changes(corners)
        geometry[:, IS_PARALLELOGRAM] = float(is_parallelogram)
        if normals is None:
            flat = _cross(geometry[:, 3:6], geometry[:, 6:9])
            flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
            normals = np.repeat(flat[:, None], 3, axis=1)
        shading = np.zeros((count, SHADING_COLUMNS))
        shading[:, :9] = _with_changes(normals)
        shading[:, UV_CORNER : UV_CORNER + 6] = _with_changes(uv)
        surfaces = np.broadcast_to(np.asarray(surface, np.int32), (count,)).copy()
        self.parts.append(Mesh(geometry, shading, surfaces))

    def grid(
        self,
        points: np.ndarray,
        uv: np.ndarray,
        surface: int,
        *,
        normals: np.ndarray | None = None,
        is_smooth: bool = False,
    ) -> None:
        """Add a sheet through points as two triangles for each of its cells.

        Points and `normals` are (rows, columns, 3), `uv` (rows, columns, 2). Without normals the
        triangles are flat, or a smooth sheet's normals follow from its points.
        """
        if is_smooth:
            normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
            normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        for order in ((0, 1, 3), (2, 3, 1)):
            self.primitives(
                cell_corners(points, order),
                cell_corners(uv, order),
                surface,
                normals=None if normals is None else cell_corners(normals, order),
            )


def _with_changes(values: np.ndarray) -> np.ndarray:
    """Values (rows, 3, numbers) as rows: at the corner, then their changes along both edges."""
    corner, first, second = values[:, 0], values[:, 1], values[:, 2]
    return np.concatenate([corner, first - corner, second - corner], axis=1)


def _cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The cross product of rows (rows, 3): `np.cross` takes six times as long for a few."""
    x, y, z = first.T
    u, v, w = second.T
    return np.stack((y * w - z * v, z * u - x * w, x * v - y * u), axis=1)


def cell_corners(values: np.ndarray, order: tuple[int, int, int]) -> np.ndarray:
    """Three of the four corners of every cell of a grid, counted round it: (cells, 3, numbers)."""
    corners = values[:-1, :-1], values[:-1, 1:], values[1:, 1:], values[1:, :-1]
    return np.stack([corners[i] for i in order], axis=2).reshape(-1, 3, values.shape[-1])
