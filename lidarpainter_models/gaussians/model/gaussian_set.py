"""The Gaussians of a scene: their parameters, and how rows come and go.

Every Gaussian lives in a body: body 0 is the street (world frame), body `i` the i-th actor (its
box frame: x along the length, y left, z up). Lengths are metres. Parameters are kept as they are
optimised: scale as its logarithm, opacity as its logit, colour as spherical harmonics with the
constant 0.5 added when rendered (Kerbl et al., 2023).
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.transforms import rotation_from_quaternion

SH_CONSTANT = 0.28209479177387814  # value of the harmonic of degree 0
PARAMETERS = ("means", "rotation_wxyz", "log_scale", "opacity_logit", "sh_dc", "sh_rest")


def sh_from_rgb(rgb: Float[Tensor, "gaussians 3"]) -> Float[Tensor, "gaussians 1 3"]:
    """Constant harmonics that show the colours as they are."""
    return ((rgb - 0.5) / SH_CONSTANT)[:, None]


def axes_at(
    rotation_wxyz: Float[Tensor, "gaussians 4"], which: Int[Tensor, " gaussians"]
) -> Float[Tensor, "gaussians 3"]:
    """Unit vectors along one axis of each Gaussian, in the frame of its body."""
    rotation = rotation_from_quaternion(rotation_wxyz)
    return rotation.gather(2, which[:, None, None].expand(-1, 3, 1))[..., 0]


class Shapes:
    """Sizes and opacities of Gaussians, kept as they are optimised."""

    log_scale: Tensor
    opacity_logit: Tensor

    @property
    def scale_m(self) -> Float[Tensor, "gaussians 3"]:
        """Standard deviations along the Gaussian's own axes."""
        return self.log_scale.exp()

    @property
    def opacity(self) -> Float[Tensor, " gaussians"]:
        """Opacities in (0, 1)."""
        return self.opacity_logit.sigmoid()


@dataclass(eq=False, kw_only=True)
class GaussianSet(Shapes):
    """All Gaussians, row by row; the parameters may be leaves of an autograd graph."""

    means: Float[Tensor, "gaussians 3"]
    rotation_wxyz: Float[Tensor, "gaussians 4"]
    log_scale: Float[Tensor, "gaussians 3"]
    opacity_logit: Float[Tensor, " gaussians"]
    sh_dc: Float[Tensor, "gaussians 1 3"]
    sh_rest: Float[Tensor, "gaussians rest 3"]
    body_index: Int[Tensor, " gaussians"]

    def __post_init__(self) -> None:
        """Refuse columns of different length and harmonics that fill no degree."""
        lengths = {field.name: getattr(self, field.name).shape[0] for field in fields(self)}
        if len(set(lengths.values())) != 1:
            raise ShapeError(f"the columns of a Gaussian set differ in length: {lengths}")
        if self.sh_rest.shape[1] not in (0, 3, 8, 15):
            raise ShapeError(f"sh_rest needs 0, 3, 8 or 15 rows, got {self.sh_rest.shape[1]}")

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return round((self.sh_rest.shape[1] + 1) ** 0.5) - 1

    @property
    def sh(self) -> Float[Tensor, "gaussians coefficients 3"]:
        """All harmonics, constant first."""
        return torch.cat([self.sh_dc, self.sh_rest], dim=1) if self.sh_rest.shape[1] else self.sh_dc

    @property
    def base_rgb(self) -> Float[Tensor, "gaussians 3"]:
        """The colour without its view-dependent part."""
        return (self.sh_dc[:, 0] * SH_CONSTANT + 0.5).clamp(min=0)

    def columns(self) -> dict[str, Tensor]:
        """Every column by name, detached."""
        return {field.name: getattr(self, field.name).detach() for field in fields(self)}

    def parameters(self) -> dict[str, Tensor]:
        """The columns that are optimised, by name."""
        return {name: getattr(self, name) for name in PARAMETERS}

    def select(self, rows: Int[Tensor, " kept"]) -> "GaussianSet":
        """The given rows, detached."""
        return type(self)(**{name: value[rows] for name, value in self.columns().items()})

    def of_body(self, body: int) -> "GaussianSet":
        """The same rows as parts of one body, in whose frame they are taken to stand; detached."""
        columns = self.columns()
        columns["body_index"] = torch.full_like(columns["body_index"], body)
        return type(self)(**columns)

    def append(self, other: "GaussianSet") -> "GaussianSet":
        """These rows followed by the other's, detached.

        Raises:
            ShapeError: the two sets have harmonics of different degree.
        """
        if self.sh_rest.shape[1] != other.sh_rest.shape[1]:
            raise ShapeError(
                f"cannot join Gaussians of SH degree {self.sh_degree} and {other.sh_degree}"
            )
        theirs = other.columns()
        return type(self)(
            **{name: torch.cat([value, theirs[name]]) for name, value in self.columns().items()}
        )

    def as_leaves(self) -> "GaussianSet":
        """A copy whose parameters collect gradients."""
        columns = {
            name: value.clone(memory_format=torch.contiguous_format)
            for name, value in self.columns().items()
        }
        for name in PARAMETERS:
            columns[name].requires_grad_(True)
        return type(self)(**columns)

    def to(self, device: torch.device | str) -> "GaussianSet":
        """The same rows on another device, detached."""
        return type(self)(**{name: value.to(device) for name, value in self.columns().items()})

    @classmethod
    def empty(cls, *, sh_degree: int = 1) -> "GaussianSet":
        """No rows."""
        return cls(
            means=torch.zeros(0, 3),
            rotation_wxyz=torch.zeros(0, 4),
            log_scale=torch.zeros(0, 3),
            opacity_logit=torch.zeros(0),
            sh_dc=torch.zeros(0, 1, 3),
            sh_rest=torch.zeros(0, (sh_degree + 1) ** 2 - 1, 3),
            body_index=torch.zeros(0, dtype=torch.int32),
        )
