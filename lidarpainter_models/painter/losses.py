"""What painters are trained to lower: terms that stand alone, and the sum of the paper.

Images are (batch, 3, height, width); masks (batch, height, width), 1 where the target is known.
A term is averaged over the pixels of its mask; over no pixel it is 0.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.kernels.ssim import ssim_map
from lidarpainter_models.painter.adversarial import Discriminator, generator_hinge_loss
from lidarpainter_models.painter.batches import ConditionBatch

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Images = Float[Tensor, "batch 3 height width"]
Mask = Float[Tensor, "batch height width"]
BatchDistance = Callable[[Images, Images], Float[Tensor, " batch"]]
"""Of images to their targets, differentiable, such as `metrics.lpips.Lpips.of_batch`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperLossWeights:
    """How much each term of the paper's loss counts: 0.2 LPIPS + 0.6 L2 + 0.4 SSIM + GAN."""

    lpips: float = 0.2
    """Of LPIPS; its weights are user-supplied, 0 leaves it out."""
    squared: float = 0.6
    """Of the mean squared error."""
    structure: float = 0.4
    """Of 1 - SSIM."""
    adversarial: float = 1.0
    """Of the generator's hinge loss; 0 trains without a discriminator."""

    def __post_init__(self) -> None:
        refuse_negative(self)


LossTerms = dict[str, Float[Tensor, ""]]
"""By the names of their weights before weighting, and `total`, the weighted sum."""


def weighed(terms: LossTerms, weights: "DataclassInstance") -> LossTerms:
    """The terms and their total."""
    total = torch.stack([getattr(weights, name) * term for name, term in terms.items()]).sum()
    return terms | {"total": total}


def as_numbers(terms: LossTerms) -> dict[str, float]:
    """Plain numbers for a log."""
    return {name: float(term.detach()) for name, term in terms.items()}


def refuse_negative(weights: "DataclassInstance") -> None:
    """Refuse loss weights under 0, and those that are no number.

    Raises:
        ConfigError: with the weight's name.
    """
    for field in fields(weights):
        if not getattr(weights, field.name) >= 0:
            raise ConfigError(f"loss weight {field.name} must not be negative")


def paper_loss(
    image: Images,
    target: Images,
    mask: Mask,
    weights: PaperLossWeights,
    *,
    lpips: BatchDistance | None = None,
    discriminator: Discriminator | None = None,
) -> LossTerms:
    """The painter's loss of the paper; a term of weight 0 is 0.

    LPIPS and the discriminator look at whole images, so where the target is unknown they see it
    in place of the image, and no gradient passes there.
    """
    known = known_image(image, target, mask)
    nothing = image.new_zeros(())
    terms = {
        "lpips": nothing,
        "squared": squared_loss(image, target, mask),
        "structure": structure_loss(image, target, mask),
        "adversarial": nothing,
    }
    if weights.lpips > 0:
        assert lpips is not None, "`Judges.check` has asked"  # noqa: S101
        terms["lpips"] = lpips(known, target).mean()
    if weights.adversarial > 0:
        assert discriminator is not None, "a trainee makes one"  # noqa: S101
        terms["adversarial"] = generator_hinge_loss(discriminator(known))
    return weighed(terms, weights)


def known_image(image: Images, target: Images, mask: Mask) -> Images:
    """The image where the target is known, the target elsewhere."""
    return torch.where(mask[:, None] > 0, image, target)


def absolute_loss(image: Images, target: Images, mask: Mask) -> Float[Tensor, ""]:
    """Mean absolute difference inside the mask."""
    return masked_mean((image - target).abs().mean(dim=1), mask)


def squared_loss(image: Images, target: Images, mask: Mask) -> Float[Tensor, ""]:
    """Mean squared difference inside the mask."""
    return masked_mean((image - target).square().mean(dim=1), mask)


def structure_loss(image: Images, target: Images, mask: Mask) -> Float[Tensor, ""]:
    """Mean of 1 - SSIM inside the mask; outside it the image counts as equal to the target."""
    known = known_image(image, target, mask)
    rows = zip(known.permute(0, 2, 3, 1), target.permute(0, 2, 3, 1), strict=True)
    similarity = torch.stack([ssim_map(ours, truth).mean(dim=-1) for ours, truth in rows])
    return masked_mean(1 - similarity, mask)


def gradient_loss(image: Images, target: Images, mask: Mask) -> Float[Tensor, ""]:
    """Mean absolute difference of horizontal and vertical steps between known neighbours."""
    gap = image - target
    across = (gap[..., 1:] - gap[..., :-1]).abs().mean(dim=1)
    down = (gap[..., 1:, :] - gap[..., :-1, :]).abs().mean(dim=1)
    horizontal = masked_mean(across, mask[..., 1:] * mask[..., :-1])
    return horizontal + masked_mean(down, mask[..., 1:, :] * mask[..., :-1, :])


def agreement_mask(conditions: ConditionBatch, difference: float) -> Mask:
    """1 where a warp is valid and every valid warp agrees with the render."""
    gaps = (conditions.warp - conditions.render[:, None]).abs().mean(dim=2)
    disagreeing = (gaps > difference) & (conditions.warp_valid > 0)
    some = conditions.warp_valid.amax(dim=1) > 0
    return (some & ~disagreeing.any(dim=1)).float()


def masked_mean(
    values: Float[Tensor, "batch rows columns"], mask: Float[Tensor, "batch rows columns"]
) -> Float[Tensor, ""]:
    """Mean inside the mask; 0 where it is empty."""
    return (values * mask).sum() / mask.sum().clamp_min(1)
