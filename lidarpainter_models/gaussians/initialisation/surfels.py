"""First values of Gaussians from points: flat ellipsoids that lie in the surface.

Each point's neighbourhood gives a normal (the direction of least variance); the Gaussian is a
disc across it. Against round blobs this start was 0.3 to 0.4 dB ahead after 300 steps.
"""

from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, sh_from_rgb
from lidarpainter_models.geometry.transforms import quaternion_from_rotation
from lidarpainter_models.observations.views import TrainingView

SPACING_SIGMA = 0.6
"""Standard deviation in the surface, in units of the distance to the neighbours."""
LEAST_THICKNESS = 0.15
"""Standard deviation across the surface, at least this part of the one along it."""
OPACITY = 0.7
"""Solid enough to hide what is behind, soft enough to be moved."""
NEIGHBOURS = 10
"""Points that define a normal."""
COLOUR_NEIGHBOURS = 4
SPACING_NEIGHBOURS = 4
"""Points that define the spacing."""
OUTLINE_SIGMA = 0.5
"""Largest standard deviation, in units of the distance to the nearest sky of an image."""
LEAST_OUTLINE_PX = 0.7
"""Size below which something may be seen as sky altogether."""


def fill_colours(
    xyz_m: Float[Tensor, "points 3"],
    rgb: Float[Tensor, "points 3"],
    has_colour: Bool[Tensor, " points"],
) -> Float[Tensor, "points 3"]:
    """Give points without colour the mean of their nearest coloured ones, or grey."""
    if bool(has_colour.all()):
        return rgb
    if not bool(has_colour.any()):
        return torch.full_like(rgb, 0.5)
    filled, known = rgb.clone(), rgb[has_colour]
    count = min(COLOUR_NEIGHBOURS, known.shape[0])
    tree = cKDTree(xyz_m[has_colour].numpy())
    _, nearest = tree.query(xyz_m[~has_colour].numpy(), k=[*range(1, count + 1)])
    filled[~has_colour] = known[torch.from_numpy(nearest)].mean(dim=1)
    return filled


def neighbourhood(
    xyz_m: Float[Tensor, "points 3"], count: int
) -> tuple[Float[Tensor, "points neighbours"], Int[Tensor, "points neighbours"]]:
    """Distances and indices of each point's nearest points, itself first."""
    count = min(count, xyz_m.shape[0])
    distance, index = cKDTree(xyz_m.numpy()).query(xyz_m.numpy(), k=[*range(1, count + 1)])
    return torch.from_numpy(distance.astype(np.float32)), torch.from_numpy(index)


def surface_axes(
    neighbours_m: Float[Tensor, "points neighbours 3"],
) -> tuple[Float[Tensor, "points 3 3"], Float[Tensor, "points 3"]]:
    """Right-handed axes (columns; the normal first) and standard deviations along them."""
    centred = neighbours_m - neighbours_m.mean(dim=1, keepdim=True)
    covariance = centred.transpose(1, 2) @ centred / neighbours_m.shape[1]
    values, axes = torch.linalg.eigh(covariance)
    axes = axes * torch.linalg.det(axes)[:, None, None].sign()
    return axes, values.clamp(min=0).sqrt()


def surfels_from_points(
    xyz_m: Float[Tensor, "points 3"],
    rgb: Float[Tensor, "points 3"],
    *,
    body: int = 0,
    sh_degree: int = 1,
    most_sigma_m: Float[Tensor, " points"] | None = None,
    least_thickness: float = LEAST_THICKNESS,
) -> GaussianSet:
    """One flat Gaussian per point, in the points' own frame.

    Harmonics start at zero but for the constant; `most_sigma_m` limits the standard deviation of
    each (lone points have far neighbours), `least_thickness` how flat it may be.
    """
    count = xyz_m.shape[0]
    if count == 0:
        return GaussianSet.empty(sh_degree=sh_degree)
    distance, index = neighbourhood(xyz_m, NEIGHBOURS + 1)
    near = distance[:, 1 : SPACING_NEIGHBOURS + 1]
    spacing_m = near.mean(dim=1) if near.shape[1] else torch.full((count,), 0.1)
    sigma_m = (spacing_m * SPACING_SIGMA).clamp(min=1e-3)
    if most_sigma_m is not None:
        sigma_m = torch.minimum(sigma_m, most_sigma_m)
    axes, spread = surface_axes(xyz_m[index].double())
    thickness = (spread[:, 0] / spread[:, 1].clamp(min=1e-6)).float()
    thickness = thickness.clamp(least_thickness, 1.0)
    scale_m = torch.stack([sigma_m * thickness, sigma_m, sigma_m], dim=1)
    opacity = torch.full((count,), OPACITY)
    return GaussianSet(
        means=xyz_m.clone(),
        rotation_wxyz=quaternion_from_rotation(axes).float(),
        log_scale=scale_m.log(),
        opacity_logit=torch.logit(opacity),
        sh_dc=sh_from_rgb(rgb),
        sh_rest=torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
        body_index=torch.full((count,), body, dtype=torch.int32),
    )


def within_outlines(gaussians: GaussianSet, views: Iterable[TrainingView]) -> GaussianSet:
    """Return Gaussians of the street, made small enough not to reach into the sky of some views.

    The neighbours of a wire's points are far: discs that span them would hide the sky, and with it
    the far towers that nothing but images shows (`unreached_gaussians`).
    """
    most_m = torch.full((len(gaussians),), torch.inf)
    for view in views:
        is_no_sky = (~view.sky_mask).numpy().astype(np.uint8)
        to_sky_px = torch.from_numpy(cv2.distanceTransform(is_no_sky, cv2.DIST_L2, cv2.DIST_MASK_5))
        pixels_uv, depth_m = view.camera.project(gaussians.means)
        is_shown = view.camera.contains(pixels_uv, depth_m)
        column, row = pixels_uv[is_shown].long().unbind(-1)
        most_px = (OUTLINE_SIGMA * to_sky_px[row, column]).clamp(min=LEAST_OUTLINE_PX)
        size_m = most_px * depth_m[is_shown] / view.camera.fx_px
        most_m[is_shown] = torch.minimum(most_m[is_shown], size_m)
    log_scale = torch.minimum(gaussians.log_scale, most_m.log()[:, None])
    return replace(gaussians, log_scale=log_scale)
