"""Flat Gaussians on the surfaces of meshes, as many a square metre everywhere.

Only what can be seen from outside gets some. Colours are what the materials say, lit by an even
sky: a face that looks up has its own colour (asphalt is then about as grey as in neutral exposure),
one that looks aside gets half of that and a little of what the road gives back.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, sh_from_rgb
from lidarpainter_models.geometry.transforms import quaternion_from_rotation

if TYPE_CHECKING:
    from trimesh import Trimesh

MOST = 30_000
"""Gaussians of one asset, about: a car's are then 3 cm apart."""
SPACING_M = 0.02
"""Between neighbours, at least."""
SPREAD, THICKNESS = 0.75, 0.08
"""Standard deviations along and across the surface, in spacings."""
OVERLAP = 2 * np.pi * SPREAD**2
"""How many Gaussians lie over one another."""
LEAST_OPAQUE, MOST_OPAQUE = 0.02, 0.999_999
SOLID = 0.5
"""What is less opaque hides nothing: glass."""
NUM_DIRECTIONS, LIFT_M = 48, 0.003
GROUND_SHARE = 0.15
"""Light of an even sky that a road gives back."""
MOST_PIXELS = 2**26
"""Of a texture."""

Places = Float[np.ndarray, "places 10"]
"""Places on surfaces: point and normal in the box frame, colour in linear light, opacity."""


def surface_gaussians(
    meshes: Sequence["Trimesh"], box_from_file: Float[Tensor, "4 4"], *, is_linear: bool
) -> GaussianSet:
    """Gaussians on meshes, carried into the box frame; harmonics of degree 0.

    Args:
        meshes: in the frame of their file.
        box_from_file: turns, scales and moves.
        is_linear: whether colours of vertices and factors of materials are linear light.

    Raises:
        DataError: they have no area, nothing of them is opaque, or a texture is no image.
    """
    carried = [mesh.copy().apply_transform(box_from_file.numpy()) for mesh in meshes]
    area_m2 = sum(float(mesh.area) for mesh in carried)
    if not 0 < area_m2 < np.inf:
        raise DataError("the mesh has no area, expected surfaces")
    step_m2 = max(area_m2 / MOST, SPACING_M**2)
    for _ in range(2):  # once to learn how much of it can be seen
        parts = [_places(one, float(one.area) / step_m2, is_linear) for one in carried]
        solid = [one for one, own in zip(carried, parts, strict=True) if own[:, 9].mean() > SOLID]
        found, spacing_m = np.concatenate(parts), step_m2**0.5
        found = found[found[:, 9] > LEAST_OPAQUE]
        found = found[_seen_from_outside(found, solid)]
        step_m2 = max(step_m2 * len(found) / MOST, SPACING_M**2)
        if not solid or not len(found):
            raise DataError("the mesh has nothing opaque, expected a thing that can be seen")
    return _flat_gaussians(torch.from_numpy(found).float(), spacing_m)


def _places(mesh: "Trimesh", count: float, is_linear: bool) -> Places:
    """Places at even steps of area from triangle to triangle, spread within each (R2 sequence)."""
    number, ends = np.arange(max(1, round(count))), np.cumsum(mesh.area_faces)
    faces = np.searchsorted(ends, (number + 0.5) / len(number) * ends[-1]).clip(0, len(ends) - 1)
    across = np.stack([number * 0.7548776662, number * 0.5698402910], axis=1) % 1
    across = np.where(across.sum(1, keepdims=True) > 1, 1 - across, across)
    weights = np.concatenate([1 - across.sum(1, keepdims=True), across], axis=1)
    points = np.einsum("pc,pcx->px", weights, mesh.triangles[faces])
    normals = np.array(mesh.face_normals[faces])
    normals *= np.where((normals * points).sum(1) < 0, -1.0, 1.0)[:, None]  # out of the box
    rgba = _colours(mesh.visual, mesh.faces[faces], weights, is_linear)
    return np.concatenate([points, normals, rgba], axis=1)


def _colours(
    visual: Any,  # noqa: ANN401 - of trimesh
    corners: Int[np.ndarray, "places 3"],
    weights: Float[np.ndarray, "places 3"],
    is_linear: bool,
) -> Float[np.ndarray, "places 4"]:
    """Linear light and opacity: a texture times the factor of its material, or of vertices."""
    if visual.kind != "texture":
        rgba = np.einsum("pc,pcx->px", weights, visual.vertex_colors[corners] / 255.0)
        return _linear(rgba, is_linear)
    from trimesh.visual.color import uv_to_interpolated_color

    material, opacity = visual.material, 1.0
    is_simple = not hasattr(material, "baseColorFactor")
    if is_simple:  # of an .mtl
        opacity = float(np.ravel(material.kwargs.get("d", 1.0))[0])
        material = material.to_pbr()
    image, factor = material.baseColorTexture, material.baseColorFactor
    rgba = np.ones((len(corners), 4))
    if image is not None and visual.uv is not None:
        if image.width * image.height > MOST_PIXELS:
            raise DataError(f"a texture of {image.width} x {image.height} pixels is too large")
        uv = np.einsum("pc,pcx->px", weights, np.nan_to_num(visual.uv)[corners])
        try:
            rgba = _linear(uv_to_interpolated_color(uv, image) / 255.0, is_linear=False)
        except (OSError, ValueError, SyntaxError) as error:
            raise DataError(f"a texture cannot be read: {error!r:.200}") from None
        factor = None if is_simple else factor
    if factor is not None:
        rgba = rgba * _linear(np.asarray(factor)[None] / 255.0, is_linear)
    if not is_simple and material.alphaMode not in ("BLEND", "MASK"):
        rgba[:, 3] = 1.0
    return rgba * np.array([1, 1, 1, opacity])


def _linear(rgba: Float[np.ndarray, "rows 4"], is_linear: bool) -> Float[np.ndarray, "rows 4"]:
    """Colours as linear light; opacity as it is."""
    if is_linear:
        return rgba
    light = np.where(rgba > 0.04045, ((rgba + 0.055) / 1.055) ** 2.4, rgba / 12.92)
    return np.concatenate([light[:, :3], rgba[:, 3:]], axis=1)


def _seen_from_outside(places: Places, solid: Sequence["Trimesh"]) -> Bool[np.ndarray, " places"]:
    """Which places some far direction shows, past everything that is not glass."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    for mesh in solid:
        vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)
        scene.add_triangles(
            open3d.core.Tensor.from_numpy(vertices), open3d.core.Tensor.from_numpy(faces)
        )
    seen, number = np.zeros(len(places), bool), np.arange(NUM_DIRECTIONS) + 0.5
    up, turn = 1 - 2 * number / NUM_DIRECTIONS, number * np.pi * (1 + 5**0.5)
    flat = np.sqrt(1 - up**2)
    for away in np.stack([flat * np.cos(turn), flat * np.sin(turn), up], axis=1):
        rows = np.flatnonzero(~seen)
        points, normals = places[rows, :3], places[rows, 3:6]
        starts = points + LIFT_M * np.sign(normals @ away)[:, None] * normals
        rays = np.concatenate([starts, np.broadcast_to(away, starts.shape)], axis=1)
        hidden = scene.test_occlusions(
            open3d.core.Tensor.from_numpy(rays.astype(np.float32))
        ).numpy()
        seen[rows] = ~hidden
    return seen


def _flat_gaussians(places: Float[Tensor, "places 10"], spacing_m: float) -> GaussianSet:
    """One Gaussian a place, along its surface, in the light of an even sky."""
    means, normals, albedo, together = places.split([3, 3, 3, 1], dim=1)
    helper = torch.where(normals[:, 2:].abs() < 0.9, torch.eye(3)[2], torch.eye(3)[0])
    across = torch.nn.functional.normalize(torch.linalg.cross(helper, normals), dim=1)
    axes = torch.stack([across, torch.linalg.cross(normals, across), normals], dim=2)
    up = normals[:, 2:]
    lit = albedo * ((1 + up) / 2 + GROUND_SHARE * (1 - up) / 2)
    rgb = torch.where(lit > 0.0031308, 1.055 * lit ** (1 / 2.4) - 0.055, lit * 12.92)
    clear = 1 - together[:, 0].double().clamp(max=MOST_OPAQUE)
    scale_m = spacing_m * torch.tensor([SPREAD, SPREAD, THICKNESS])
    return GaussianSet(
        means=means.contiguous(),
        rotation_wxyz=quaternion_from_rotation(axes.double()).float(),
        log_scale=scale_m.log().repeat(len(means), 1),
        opacity_logit=(1 - clear ** (1 / OVERLAP)).logit().float(),
        sh_dc=sh_from_rgb(rgb),
        sh_rest=torch.zeros(len(means), 0, 3),
        body_index=torch.zeros(len(means), dtype=torch.int32),
    )
