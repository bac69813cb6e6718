"""LPIPS (Zhang et al., 2018), version 0.1, with weights that the user supplies in two files.

A backbone (`backbones.py`) looks at both images; at each compared depth the squared differences
of its unit features are weighed by a learned linear head, averaged over positions, and summed. A
head belongs to the very weights it was learnt on: channels of another training run mean something
else. So a backbone counts only if its SHA-256 is that of torchvision's file; no other network is
ever put in its place.
"""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lidarpainter_models.errors import ShapeError, WeightsError
from lidarpainter_models.metrics.backbones import (
    BACKBONES,
    Backbone,
    FeatureStack,
    is_published,
    load_stack,
    read_tensors,
)
from lidarpainter_models.metrics.lpips_files import LpipsFiles

SHIFT_RGB = (-0.030, -0.088, -0.188)
SCALE_RGB = (0.458, 0.448, 0.450)
"""Images in [-1, 1] are shifted and scaled by these before the backbone sees them."""
LEAST_SIDE_PX = 64
"""Smaller images vanish in the pooling of AlexNet and SqueezeNet."""
HEAD_KEY = "lin{}.model.1.weight"


class Lpips(nn.Module):
    """The distance of two images; differentiable in both."""

    def __init__(self, backbone: FeatureStack, heads: list[Float[Tensor, " _"]]) -> None:
        """Take a frozen backbone and the weights of its channels at every compared depth."""
        super().__init__()
        self.backbone = backbone
        self.channels = tuple(len(head) for head in heads)
        """Numbers of channels of the backbone at every compared depth."""
        for index, head in enumerate(heads):
            self.register_buffer(f"head_{index}", head[:, None, None])
        self.register_buffer("shift", torch.tensor(SHIFT_RGB)[:, None, None])
        self.register_buffer("scale", torch.tensor(SCALE_RGB)[:, None, None])

    def forward(
        self, image: Float[Tensor, "height width 3"], truth: Float[Tensor, "height width 3"]
    ) -> Float[Tensor, ""]:
        """The distance of one image with rgb in [0, 1]; 0 for equal ones."""
        one, other = (view.permute(2, 0, 1)[None] for view in (image, truth))
        return self.of_batch(one, other)[0]

    def of_batch(
        self, images: Float[Tensor, "batch 3 height width"], truths: Float[Tensor, "batch 3 _ _"]
    ) -> Float[Tensor, " batch"]:
        """The distances of a batch.

        Raises:
            ShapeError: the images differ in size, or are smaller than 64 pixels.
        """
        if images.shape != truths.shape or min(images.shape[2:]) < LEAST_SIDE_PX:
            raise ShapeError(
                f"LPIPS needs two images of one size, at least {LEAST_SIDE_PX} px, got "
                f"{tuple(images.shape)} and {tuple(truths.shape)}"
            )
        seen = [self.features(views) for views in (images, truths)]
        total = images.new_zeros(len(images))
        for index, (one, other) in enumerate(zip(*seen, strict=True)):
            weighed = (one - other).square() * self.get_buffer(f"head_{index}")
            total = total + weighed.sum(dim=1).mean(dim=(1, 2))
        return total

    def features(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> list[Float[Tensor, "batch channels rows columns"]]:
        """What the backbone sees in images with rgb in [0, 1], at every compared depth."""
        shifted = 2 * images - 1 - self.get_buffer("shift")
        return self.backbone.compared_features(shifted / self.get_buffer("scale"))


def load_lpips(files: LpipsFiles, device: torch.device | None = None) -> Lpips | None:
    """Read LPIPS from its two files, to a device; None where one is not named.

    Raises:
        WeightsError: a file is missing or unreadable, the two belong to different networks, or
            the backbone is not the one the heads were learnt on.
    """
    if files.backbone is None or files.heads is None:
        return None
    backbone, heads = read_heads(files.heads)
    stack = load_stack(files.backbone, backbone)
    if not is_published(files.backbone, backbone):
        digests = " or ".join(backbone.published)
        raise WeightsError(
            f"{files.backbone} is not the {backbone.name} that LPIPS was learnt on: expected "
            f"torchvision's file, whose SHA-256 begins with {digests}"
        )
    return Lpips(stack, heads).eval().requires_grad_(requires_grad=False).to(device)


def read_heads(path: Path) -> tuple[Backbone, list[Float[Tensor, " _"]]]:
    """Linear heads, and the backbone they belong to by their channels.

    Raises:
        WeightsError: the file is missing, unreadable, or holds no heads of a known backbone.
    """
    state = read_tensors(path, "LPIPS head")
    shapes = {name: tuple(tensor.shape) for name, tensor in state.items()}
    for backbone in BACKBONES:
        wanted = {HEAD_KEY.format(i): (1, n, 1, 1) for i, n in enumerate(backbone.channels)}
        if shapes == wanted:
            heads = [state[name].float().flatten() for name in wanted]
            if not all(bool((head.isfinite() & (head >= 0)).all()) for head in heads):
                raise WeightsError(f"{path} holds LPIPS heads that are negative or not finite")
            return backbone, heads
    known = ", ".join(backbone.name for backbone in BACKBONES)
    raise WeightsError(f"{path} does not hold the LPIPS heads of {known}")
