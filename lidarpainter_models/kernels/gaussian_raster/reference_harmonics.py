"""Real spherical harmonics up to degree 3 in plain torch (constants of Kerbl et al. 2023)."""

import torch
from jaxtyping import Float
from torch import Tensor


def harmonic_basis(
    direction: Float[Tensor, "directions 3"], coefficients: int
) -> Float[Tensor, "directions coefficients"]:
    """The first 1, 4, 9 or 16 basis values at unit directions."""
    x, y, z = direction.unbind(dim=1)
    basis = [torch.full_like(x, 0.28209479177387814)]
    if coefficients > 1:
        basis += [value * 0.4886025119029199 for value in (-y, z, -x)]
    if coefficients > 4:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if coefficients > 9:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, dim=1)
