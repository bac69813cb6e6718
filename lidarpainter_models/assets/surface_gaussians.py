"""Flat Gaussians on the surfaces of meshes, as many a square metre everywhere.

Only what can be seen from outside gets some. Colours are what the materials say, lit by an even
sky: a face that looks up has its own colour (asphalt is then about as grey as in neutral exposure),
one that looks aside gets half of that and a little of what the road gives back.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.assets.painted_parts import PaintedPart, painted_parts
from lidarpainter_models.errors import DataError
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, sh_from_rgb
from lidarpainter_models.geometry.transforms import quaternion_from_rotation

if TYPE_CHECKING:
    from trimesh import Trimesh

MOST = 30_000
"""Gaussians of one asset, roughly: those of a car are then 3 cm apart."""
SPACING_M = 0.02
"""Neighbours are at least this far apart."""
SPREAD, THICKNESS = 0.75, 0.08
"""Standard deviations along and across the surface, in spacings."""
OVERLAP = 2 * np.pi * SPREAD**2
"""Mean number of Gaussians that lie over one another at a place."""
LEAST_OPAQUE, MOST_OPAQUE = 0.02, 0.999_999
"""Places that are less opaque get no Gaussian; none is more opaque, for logits are finite."""
SOLID = 0.5
"""A part whose mean opacity is less than this is glass: it hides nothing behind it."""
NUM_DIRECTIONS, LIFT_M = 48, 0.003
"""Directions from which a place is looked for, and how far off its surface a ray begins."""
GROUND_SHARE = 0.15
"""Share of the light of an even sky that a road reflects upwards."""
MOST_TRIED = 20
"""Limit on the places that are tried for each Gaussian that is wanted: where most of a thing lies
hidden inside, it gets fewer Gaussians in place of endless work."""

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
    parts = painted_parts(meshes, box_from_file.numpy())
    area_m2 = sum(float(part.mesh.area) for part in parts)
    if not 0 < area_m2 < np.inf:
        raise DataError("the mesh has no area, expected surfaces")
    step_m2 = max(area_m2 / MOST, SPACING_M**2)
    for _ in range(2):  # once to learn how much of it can be seen
        places = [_places(one, float(one.mesh.area) / step_m2, is_linear) for one in parts]
        solid = [one.mesh for one, own in zip(parts, places, strict=True) if _is_solid(own)]
        found, spacing_m = np.concatenate(places), step_m2**0.5
        found = found[found[:, 9] > LEAST_OPAQUE]
        found = _seen_from_outside(found, solid)
        if not solid or not len(found):
            raise DataError("the mesh has nothing opaque, expected a thing that can be seen")
        wanted_m2 = max(step_m2 * len(found) / MOST, SPACING_M**2)
        step_m2 = max(wanted_m2, area_m2 / (MOST_TRIED * MOST))
    return _flat_gaussians(torch.from_numpy(found).float(), spacing_m)


def _is_solid(places: Places) -> bool:
    return float(places[:, 9].mean()) > SOLID


def _places(part: PaintedPart, count: float, is_linear: bool) -> Places:
    """Places at even steps of area from triangle to triangle, spread within each (R2 sequence)."""
    mesh = part.mesh
    number, ends = np.arange(max(1, round(count))), np.cumsum(mesh.area_faces)
    faces = np.searchsorted(ends, (number + 0.5) / len(number) * ends[-1]).clip(0, len(ends) - 1)
    across = np.stack([number * 0.7548776662, number * 0.5698402910], axis=1) % 1
    across = np.where(across.sum(1, keepdims=True) > 1, 1 - across, across)
    weights = np.concatenate([1 - across.sum(1, keepdims=True), across], axis=1)
    points = np.einsum("pc,pcx->px", weights, mesh.triangles[faces])
    rgba = part.colours(mesh.faces[faces], weights, is_linear)
    return np.concatenate([points, mesh.face_normals[faces], rgba], axis=1)


def _seen_from_outside(places: Places, solid: Sequence["Trimesh"]) -> Float[np.ndarray, "seen 10"]:
    """The places that some far direction shows, past everything that is not glass.

    Their normals point to the side that was seen first, from above if that shows them: a file may
    wind its triangles either way round, and the bed of a pickup looks up into the sky.
    """
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    for mesh in solid:
        vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)
        scene.add_triangles(
            open3d.core.Tensor.from_numpy(vertices), open3d.core.Tensor.from_numpy(faces)
        )
    oriented, seen = places.copy(), np.zeros(len(places), bool)
    number = np.arange(NUM_DIRECTIONS) + 0.5
    up, turn = 1 - 2 * number / NUM_DIRECTIONS, number * np.pi * (1 + 5**0.5)
    flat = np.sqrt(1 - up**2)
    for away in np.stack([flat * np.cos(turn), flat * np.sin(turn), up], axis=1):
        rows = np.flatnonzero(~seen)
        points, normals = oriented[rows, :3], oriented[rows, 3:6]
        normals = np.where((normals @ away)[:, None] < 0, -normals, normals)
        starts = points + LIFT_M * normals
        rays = np.concatenate([starts, np.broadcast_to(away, starts.shape)], axis=1)
        hidden = scene.test_occlusions(
            open3d.core.Tensor.from_numpy(rays.astype(np.float32))
        ).numpy()
        oriented[rows, 3:6], seen[rows] = normals, ~hidden
    return oriented[seen]


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
