"""Gaussians as one view shows them, with nothing left to be reckoned from parameters."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownGaussians:
    """Gaussians ready to be drawn, with colours for one view."""

    means: Float[Tensor, "gaussians 3"]
    rotation_wxyz: Float[Tensor, "gaussians 4"]
    scale_m: Float[Tensor, "gaussians 3"]
    opacity: Float[Tensor, " gaussians"]
    sh: Float[Tensor, "gaussians coefficients 3"]
    body_index: Int[Tensor, " gaussians"]

    def __len__(self) -> int:
        return self.means.shape[0]
