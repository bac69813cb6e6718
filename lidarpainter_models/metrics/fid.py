"""How far one set of images is from another: FID and KID, of features of each image.

FID (Heusel et al., 2017) is the distance of two normal distributions. What it comes to on average
depends on how many images there are, most where they are few (Chong and Forsyth, 2020), so it is
compared at equal numbers only. KID (Binkowski et al., "Demystifying MMD GANs", 2018) comes to the
same on average for any number, and stands beside it.
"""

import torch
from jaxtyping import Float
from torch import Tensor

LEAST_IMAGES = 2
TOO_FEW = f"FID and KID compare sets of at least {LEAST_IMAGES} images"


def frechet_distance(
    real: Float[Tensor, "images features"], other: Float[Tensor, "others features"]
) -> float:
    """FID: squared distance of the means, plus the trace of S + T - 2 (S T)^(1/2).

    S and T are the covariances. The trace of (S T)^(1/2) is the sum of the singular values of the
    product of the centred sets, so no root of a matrix is taken, and few images are no trouble.
    """
    one, two = (_centred(features.double()) for features in (real, other))
    between = (real.double().mean(0) - other.double().mean(0)).square().sum()
    shared = torch.linalg.svdvals(one @ two.T).sum()
    return float(between + one.square().sum() + two.square().sum() - 2 * shared)


def _centred(features: Float[Tensor, "images features"]) -> Float[Tensor, "images features"]:
    """X with X^T X the covariance (unbiased)."""
    return (features - features.mean(0)) / (len(features) - 1) ** 0.5


def kernel_distance(
    real: Float[Tensor, "images features"], other: Float[Tensor, "others features"]
) -> float:
    """KID: the unbiased squared maximum mean discrepancy by the kernel (x y / features + 1)^3.

    All images are compared at once. Means over random subsets of them, as others take, have the
    same expected value.
    """
    one, two = real.double(), other.double()
    within = [_mean_off_diagonal(_kernel(each, each)) for each in (one, two)]
    return float(sum(within) - 2 * _kernel(one, two).mean())


def _kernel(
    one: Float[Tensor, "images features"], two: Float[Tensor, "others features"]
) -> Float[Tensor, "images others"]:
    return (one @ two.T / one.shape[1] + 1) ** 3


def _mean_off_diagonal(square: Float[Tensor, "images images"]) -> Float[Tensor, ""]:
    count = len(square)
    return (square.sum() - square.diagonal().sum()) / (count * (count - 1))
