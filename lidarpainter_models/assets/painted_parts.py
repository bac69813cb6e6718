"""Meshes made ready for sampling: parts that are painted alike become one part.

A car of others may have thousands of parts that share a few materials. Geometry is moved into the
box frame here; a texture is neither copied nor decoded again.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int, Shaped

from lidarpainter_models.assets.foreign_images import BAD_IMAGE
from lidarpainter_models.errors import DataError

if TYPE_CHECKING:
    from trimesh import Trimesh

OPAQUE_BYTE = 127
"""Vertices whose mean opacity is above this belong to a part that hides what lies behind it."""

_Geometry = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Vertices in the box frame, triangles, and what the paint needs of each vertex."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Paint:
    """Where the colours of a part come from: its vertices, or a material."""

    is_by_vertex: bool = False
    is_solid: bool = True
    """Whether colours of vertices are mostly opaque; glass and metal are kept apart."""
    image: Any | None = None
    factor: tuple[int, ...] = (255, 255, 255, 255)
    """Multiplies the texture, or is the colour where there is none."""
    has_alpha: bool = False
    """Whether the opacity of texture and factor counts."""
    opacity: float = 1.0

    @property
    def key(self) -> tuple[Any, ...]:
        """Equal for paints that look the same."""
        flags = (self.is_by_vertex, self.is_solid, self.has_alpha)
        return (*flags, id(self.image), self.factor, self.opacity)


@dataclass(frozen=True, kw_only=True, eq=False)
class PaintedPart:
    """Triangles in the box frame that share a paint."""

    mesh: "Trimesh"
    paint: Paint
    by_vertex: Shaped[np.ndarray, "vertices _"]
    """Colours as bytes, places on the texture, or nothing (width 0), as the paint needs."""

    def colours(
        self,
        corners: Int[np.ndarray, "places 3"],
        weights: Float[np.ndarray, "places 3"],
        is_linear: bool,
    ) -> Float[np.ndarray, "places 4"]:
        """Linear light and opacity at places within triangles.

        Raises:
            DataError: its texture cannot be read.
        """
        paint = self.paint
        values = np.einsum("pc,pcx->px", weights, self.by_vertex[corners])
        if paint.is_by_vertex:
            return linear(values / 255.0, is_linear)
        rgba = np.tile(linear(np.array([paint.factor]) / 255.0, is_linear), (len(corners), 1))
        if paint.image is not None:
            from trimesh.visual.color import uv_to_interpolated_color

            try:
                rgba *= linear(uv_to_interpolated_color(values, paint.image) / 255.0, False)
            except BAD_IMAGE as error:
                raise DataError(f"a texture cannot be read: {error!r:.200}") from None
        if not paint.has_alpha:
            rgba[:, 3] = 1.0
        return rgba * np.array([1, 1, 1, paint.opacity])


def painted_parts(
    meshes: Sequence["Trimesh"], box_from_file: Float[np.ndarray, "4 4"]
) -> list[PaintedPart]:
    """All triangles of meshes in the box frame, one part for each paint.

    Raises:
        DataError: a material says an opacity that is no number.
    """
    import trimesh

    groups: dict[tuple[Any, ...], tuple[Paint, list[_Geometry]]] = {}
    for mesh in meshes:
        paint, vertices = _paint(mesh.visual), np.asarray(mesh.vertices)
        moved = vertices @ box_from_file[:3, :3].T + box_from_file[:3, 3]
        own = (moved, np.asarray(mesh.faces), _by_vertex(mesh, paint))
        groups.setdefault(paint.key, (paint, []))[1].append(own)
    parts = []
    for paint, geometries in groups.values():
        sizes = [len(vertices) for vertices, _, _ in geometries]
        starts = np.cumsum(sizes) - sizes
        faces = [own[1] + start for own, start in zip(geometries, starts, strict=True)]
        whole = trimesh.Trimesh(
            np.concatenate([own[0] for own in geometries]), np.concatenate(faces), process=False
        )
        by_vertex = np.concatenate([own[2] for own in geometries])
        parts.append(PaintedPart(mesh=whole, paint=paint, by_vertex=by_vertex))
    return parts


def linear(rgba: Float[np.ndarray, "rows 4"], is_linear: bool) -> Float[np.ndarray, "rows 4"]:
    """Colours as linear light; opacity as it is."""
    if is_linear:
        return rgba
    light = np.where(rgba > 0.04045, ((rgba + 0.055) / 1.055) ** 2.4, rgba / 12.92)
    return np.concatenate([light[:, :3], rgba[:, 3:]], axis=1)


def _by_vertex(mesh: "Trimesh", paint: Paint) -> Shaped[np.ndarray, "vertices _"]:
    visual: Any = mesh.visual
    if paint.is_by_vertex:
        return np.asarray(visual.vertex_colors)
    if paint.image is not None:
        return np.nan_to_num(np.asarray(visual.uv)[:, :2])
    return np.zeros((len(mesh.vertices), 0))


def _paint(visual: Any) -> Paint:  # noqa: ANN401 - of trimesh
    if visual.kind != "texture":
        return Paint(
            is_by_vertex=True, is_solid=float(visual.vertex_colors[:, 3].mean()) > OPAQUE_BYTE
        )
    material, opacity = visual.material, 1.0
    is_of_mtl = not hasattr(material, "baseColorFactor")
    if is_of_mtl:
        said = np.ravel(getattr(material, "kwargs", {}).get("d", 1.0))
        try:
            opacity = float(said[0])
        except (LookupError, ValueError):
            raise DataError(f"a material is {said!r:.100} opaque, expected a number") from None
        material = material.to_pbr()
    image = None if visual.uv is None else material.baseColorTexture
    factor = material.baseColorFactor
    has_factor = factor is not None and not (is_of_mtl and image is not None)
    return Paint(
        image=image,
        factor=tuple(np.ravel(factor).tolist()) if has_factor else (255, 255, 255, 255),
        has_alpha=is_of_mtl or material.alphaMode in ("BLEND", "MASK"),
        opacity=opacity,
    )
