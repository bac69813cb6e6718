"""What an exported scene loses: read back and rendered beside the scene it was made from."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.drawing import (
    camera_from_body,
    draw_gaussians,
    draw_over_sky,
)
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.sky import SkyTexture
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.metrics.images import psnr_from_error, squared_error


@dataclass(frozen=True, slots=True, kw_only=True)
class Fidelity:
    """How close the images of an exported scene are to ours."""

    psnr_db: float
    """PSNR of all images together; infinite where they are the same."""
    worst_psnr_db: float
    """PSNR of the worst image."""
    num_views: int


def fidelity(
    scene: GaussianScene,
    exported_world: GaussianSet,
    timestamp_ns: int,
    cameras: Sequence[Camera],
    *,
    sky: SkyTexture | None,
) -> Fidelity:
    """Compare at some cameras, all at the time of the export.

    `exported_world` is what others read of it; without a `sky` it is drawn over black.
    """
    errors = []
    for camera in cameras:
        ours = scene.render(camera, timestamp_ns).rgb.clamp(0, 1)
        theirs = world_image(exported_world, camera, sky)
        errors.append(float(squared_error(theirs, ours).double().mean()))
    return Fidelity(
        psnr_db=psnr_from_error(sum(errors) / len(errors)),
        worst_psnr_db=psnr_from_error(max(errors)),
        num_views=len(errors),
    )


def world_image(
    gaussians_world: GaussianSet, camera: Camera, sky: SkyTexture | None
) -> Float[Tensor, "height width 3"]:
    """Gaussians that all stand in the world, over a sky or over black."""
    nobody = torch.zeros(0, 4, 4, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    bodies = camera_from_body(camera.world_from_camera, *nobody)
    if sky is None:
        return draw_gaussians(gaussians_world, bodies, camera).rgb
    return draw_over_sky(gaussians_world, bodies, sky, camera).rgb
