"""What the small painter is trained to lower: its own sum of the terms of `painter.losses`.

Images are (batch, 3, height, width); masks (batch, height, width), 1 where the target is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.painter.batches import ConditionBatch
from lidarpainter_models.painter.losses import (
    Images,
    LossTerms,
    Mask,
    absolute_loss,
    agreement_mask,
    gradient_loss,
    masked_mean,
    refuse_negative,
    squared_loss,
    structure_loss,
    weighed,
)
from lidarpainter_models.painter.nano.network import NanoOutput


@dataclass(frozen=True, slots=True, kw_only=True)
class NanoLossWeights:
    """How much each term counts."""

    absolute: float = 1.0
    squared: float = 2.0
    """The measure of PSNR itself."""
    structure: float = 0.12
    """Factor of 1 - SSIM."""
    gradient: float = 0.25
    """Edges; without it distant things come out soft."""
    expected_error: float = 0.02
    """Laplace likelihood of the error head; small, because its image is a side product."""
    keep: float = 0.1
    """Against changing what render and warps already agree on."""
    agreement: float = 0.03
    """Mean absolute rgb difference up to which render and warp agree."""
    harm: float = 4.0
    """Against a squared error above that of the render or the base, whichever is less: undamaged
    pixels are many and their errors small, so the plain errors let them pay for damaged ones."""

    def __post_init__(self) -> None:
        refuse_negative(self)


def painting_loss(
    output: NanoOutput,
    conditions: ConditionBatch,
    target: Images,
    target_valid: Mask,
    weights: NanoLossWeights,
    *,
    restyled: Bool[Tensor, " batch"] | None = None,
    sees_render: bool = True,
) -> LossTerms:
    """All terms of a batch and their total, which is minimised.

    Views that are `restyled` have a target in another style and nothing to keep. Where the network
    was not shown the render, the base stands for it.
    """
    kept = target_valid
    if restyled is not None:
        kept = kept * (~restyled)[:, None, None].to(kept)
    agreeing = agreement_mask(conditions, weights.agreement) * kept
    before = (conditions.render, output.base) if sees_render else (output.base,)
    terms = {
        "absolute": absolute_loss(output.rgb, target, target_valid),
        "squared": squared_loss(output.rgb, target, target_valid),
        "structure": structure_loss(output.rgb, target, target_valid),
        "gradient": gradient_loss(output.rgb, target, target_valid),
        "expected_error": expected_error_loss(output, target, target_valid),
        "keep": absolute_loss(output.rgb, output.base, agreeing),
        "harm": harm_loss(output.rgb, before, target, kept),
    }
    return weighed(terms, weights)


def harm_loss(
    image: Images,
    before: Sequence[Images],
    target: Images,
    mask: Mask,
) -> Float[Tensor, ""]:
    """Mean rise of a pixel's squared error over the least of those before; a fall counts as 0."""
    error, *errors_before = ((each - target).square().mean(dim=1) for each in (image, *before))
    least = torch.stack(errors_before).amin(dim=0)
    return masked_mean((error - least).clamp_min(0), mask)


def expected_error_loss(output: NanoOutput, target: Images, mask: Mask) -> Float[Tensor, ""]:
    """Negative log likelihood of the error under a Laplace law of scale exp(log_error).

    The error is taken as given, so this term never changes the image.
    """
    error = (output.rgb.detach().clamp(0, 1) - target).abs().mean(dim=1)
    return masked_mean(error * torch.exp(-output.log_error) + output.log_error, mask)
