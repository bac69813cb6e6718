"""The perceptual distances that a judge may have at hand, and why one is absent."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.metrics.backbones import load_squeezenet_distance
from lidarpainter_models.metrics.inception import Inception, load_inception
from lidarpainter_models.metrics.lpips import load_lpips
from lidarpainter_models.metrics.lpips_files import LpipsFiles

ImageDistance = Callable[
    [Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]], Float[Tensor, ""]
]
"""A distance of an image to the truth, such as `SqueezeNetDistance` or `Lpips`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PerceptualDistances:
    """What can be said beside PSNR and SSIM."""

    features: ImageDistance | None = None
    """The SqueezeNet feature distance."""
    lpips: ImageDistance | None = None
    lpips_missing: str | None = LpipsFiles().missing
    """Why there is no LPIPS; None where there is."""
    inception: Inception | None = None
    """The network of FID and KID."""


def load_distances(
    feature_weights: Path | None,
    lpips: LpipsFiles,
    device: torch.device | None = None,
    *,
    inception: Path | None = None,
) -> PerceptualDistances:
    """Load every distance whose weights are named, to a device.

    Raises:
        WeightsError: a file that is named cannot be used.
    """
    features = None
    if feature_weights is not None:
        features = load_squeezenet_distance(feature_weights).to(device)
    return PerceptualDistances(
        features=features,
        lpips=load_lpips(lpips, device),
        lpips_missing=lpips.missing,
        inception=None if inception is None else load_inception(inception, device),
    )
