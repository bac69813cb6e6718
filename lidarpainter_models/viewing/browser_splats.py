"""Gaussians as viser's client draws them: a covariance, one colour and an opacity each.

The client knows no spherical harmonics, so each Gaussian shows the colour in which the recorded
cameras saw it on average. Centres and covariances stay in the Gaussian's own body (the world for
the street, the box frame for an actor), which the client moves as a whole; metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rotation_from_quaternion
from lidarpainter_models.kernels.gaussian_raster.blending_limits import COLOUR_OFFSET
from lidarpainter_models.kernels.gaussian_raster.reference import harmonic_basis

MIN_OPACITY = 0.01
"""The client draws nothing fainter."""
MOST_CAMERAS = 24
"""Recorded cameras whose colours are averaged; more change nothing to be seen."""
_NEAR_M = 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class BrowserSplats:
    """Rows for viser's `add_gaussian_splats`."""

    centres: Float[Tensor, "splats 3"]
    covariances: Float[Tensor, "splats 3 3"]
    rgb: Float[Tensor, "splats 3"]
    opacity: Float[Tensor, "splats 1"]


def splats_by_body(
    gaussians: GaussianSet, rgb: Float[Tensor, "gaussians 3"]
) -> dict[int, BrowserSplats]:
    """What can be seen of every body that has any, in the frame of the body."""
    rows = (gaussians.opacity.detach() >= MIN_OPACITY).nonzero()[:, 0]
    rows = rows[torch.argsort(gaussians.body_index[rows], stable=True)]
    bodies, counts = torch.unique_consecutive(gaussians.body_index[rows], return_counts=True)
    parts = rows.split(counts.tolist())
    return {
        int(body): _splats(gaussians.select(part), rgb[part])
        for body, part in zip(bodies, parts, strict=True)
    }


def _splats(gaussians: GaussianSet, rgb: Float[Tensor, "gaussians 3"]) -> BrowserSplats:
    axes = rotation_from_quaternion(gaussians.rotation_wxyz) * gaussians.scale_m[:, None]
    return BrowserSplats(
        centres=gaussians.means,
        covariances=axes @ axes.transpose(1, 2),
        rgb=rgb.clamp(0, 1),
        opacity=gaussians.opacity[:, None],
    )


def recorded_rgb(
    scene: GaussianScene, cameras: Sequence[tuple[Camera, int]]
) -> Float[Tensor, "gaussians 3"]:
    """The colour of every Gaussian, on average over the cameras that have it in their image.

    Each camera comes with its time in nanoseconds; where there are many, some of them are taken. A
    Gaussian that none of them sees keeps its constant colour.
    """
    gaussians = scene.gaussians
    total, weight = torch.zeros(len(gaussians), 3), torch.zeros(len(gaussians), 1)
    step = max(1, -(-len(cameras) // MOST_CAMERAS))
    with torch.no_grad():
        for camera, timestamp_ns in cameras[::step]:
            rows, seen_rgb = _seen(scene, camera, timestamp_ns)
            total[rows] += seen_rgb
            weight[rows] += 1
        return torch.where(weight > 0, total / weight.clamp(min=1), gaussians.base_rgb)


def _seen(
    scene: GaussianScene, camera: Camera, timestamp_ns: int
) -> tuple[Int[Tensor, " seen"], Float[Tensor, "seen 3"]]:
    """The Gaussians whose centres lie in an image, and their colours in it."""
    drawable = scene.drawable(camera, timestamp_ns)
    gaussians = drawable.gaussians
    own = drawable.posed.bodies[gaussians.body_index.long()]
    points = torch.einsum("gij,gj->gi", own[:, :3, :3], gaussians.means) + own[:, :3, 3]
    x, y, z = points.unbind(1)
    u, v = camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px
    inside = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
    rows = (inside & (z > _NEAR_M)).nonzero()[:, 0]
    towards = torch.einsum("gji,gj->gi", own[rows, :3, :3], points[rows])  # in the body's frame
    basis = harmonic_basis(torch.nn.functional.normalize(towards, dim=1), gaussians.sh.shape[1])
    rgb = COLOUR_OFFSET + torch.einsum("gk,gkc->gc", basis, gaussians.sh[rows])
    return drawable.rows[rows], rgb.clamp(min=0)
