"""Gaussians with all their harmonics in one tensor.

Such are those that a step of a fit may see, as leaves that collect its gradients, and those that a
style has given other colours.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, Shapes

LEAVES = ("means", "rotation_wxyz", "log_scale", "opacity_logit", "sh")


@dataclass(frozen=True, eq=False, kw_only=True)
class SeenGaussians(Shapes):
    """Some rows of a Gaussian set, in order; all harmonics in one tensor, constant first."""

    rows: Int[Tensor, " seen"]
    """Where they stand in the set."""
    means: Float[Tensor, "seen 3"]
    rotation_wxyz: Float[Tensor, "seen 4"]
    log_scale: Float[Tensor, "seen 3"]
    opacity_logit: Float[Tensor, " seen"]
    sh: Float[Tensor, "seen coefficients 3"]
    body_index: Int[Tensor, " seen"]

    @classmethod
    def room(cls, gaussians: GaussianSet, rows: Int[Tensor, " seen"]) -> "SeenGaussians":
        """Leaves for the given rows of a set; their values are still to be written."""
        count, coefficients = len(rows), 1 + gaussians.sh_rest.shape[1]
        leaf = partial(torch.empty, device=gaussians.means.device, requires_grad=True)
        return cls(
            rows=rows,
            means=leaf(count, 3),
            rotation_wxyz=leaf(count, 4),
            log_scale=leaf(count, 3),
            opacity_logit=leaf(count),
            sh=leaf(count, coefficients, 3),
            body_index=gaussians.body_index[rows],
        )

    @classmethod
    def of(
        cls, gaussians: GaussianSet, sh: Float[Tensor, "gaussians coefficients 3"]
    ) -> "SeenGaussians":
        """All rows of a set, without gradient, in other colours."""
        columns = gaussians.columns()
        return cls(
            rows=torch.arange(len(gaussians), device=sh.device),
            **{name: columns[name] for name in ("means", "rotation_wxyz", "log_scale")},
            opacity_logit=columns["opacity_logit"],
            sh=sh,
            body_index=columns["body_index"],
        )

    def __len__(self) -> int:
        return self.rows.shape[0]

    def twin(self) -> "SeenGaussians":
        """The same values as leaves of their own, for another thread.

        Threads must not share leaves: where autograd meets one it takes its lock and then asks for
        the interpreter's, which a thread that waits for the first may hold: both wait for ever.
        """
        own = {name: value.requires_grad_(True) for name, value in self.values().items()}
        return replace(self, **own)

    def take_gradients_of(self, twin: "SeenGaussians") -> None:
        """Add what a twin collected to what these did."""
        for name in LEAVES:
            leaf, found = getattr(self, name), getattr(twin, name).grad
            if found is not None:
                leaf.grad = found if leaf.grad is None else leaf.grad + found

    def values(self) -> dict[str, Tensor]:
        """The leaves by name, detached."""
        return {name: getattr(self, name).detach() for name in LEAVES}

    def gradients(self) -> dict[str, Tensor]:
        """What the leaves collected, by name; zeros where nothing came."""
        leaves = {name: getattr(self, name) for name in LEAVES}
        return {
            name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
            for name, leaf in leaves.items()
        }


AnyGaussians = TypeVar("AnyGaussians", GaussianSet, SeenGaussians)
DrawableGaussians = GaussianSet | SeenGaussians
"""Gaussians in their bodies, as they are drawn."""
