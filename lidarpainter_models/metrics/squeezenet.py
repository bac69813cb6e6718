"""SqueezeNet feature distance: a perceptual distance whose weights the user supplies.

The network is SqueezeNet 1.1 as its authors trained it in Caffe, sliced as in Zhang et al. (2018).
The distance is theirs without the learned linear heads: at seven depths the channel-normalised
features are compared and the squared differences averaged over positions and summed. It is *not*
LPIPS (`lpips.py`), and is never reported under that name.
"""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.metrics.backbones import (
    SQUEEZENET,
    FeatureStack,
    is_published,
    load_stack,
)

CHANNEL_MEAN_BGR = (103.939, 116.779, 123.68)
"""Subtracted from BGR images in 0..255 before the first convolution."""


class SqueezeNetDistance(nn.Module):
    """Distance between two images in the feature spaces of SqueezeNet 1.1."""

    def __init__(self, layers: FeatureStack) -> None:
        super().__init__()
        self.layers = layers

    def features(
        self, rgb: Float[Tensor, "height width 3"]
    ) -> list[Float[Tensor, "1 channels rows columns"]]:
        """Channel-normalised features at the compared depths."""
        bgr = rgb.flip(-1) * 255 - torch.tensor(CHANNEL_MEAN_BGR, device=rgb.device)
        return self.layers.compared_features(bgr.permute(2, 0, 1)[None])

    def forward(
        self, image: Float[Tensor, "height width 3"], truth: Float[Tensor, "height width 3"]
    ) -> Float[Tensor, ""]:
        """The distance; 0 for equal images."""
        pairs = zip(self.features(image), self.features(truth), strict=True)
        return torch.stack([(a - b).square().sum(1).mean() for a, b in pairs]).sum()


def load_squeezenet_distance(path: Path) -> SqueezeNetDistance:
    """Read SqueezeNet 1.1 feature weights (torchvision key names, `features.` optional).

    Raises:
        WeightsError: the file is missing, unreadable, holds another network, or is torchvision's,
            which was trained on other colours.
    """
    layers = load_stack(path, SQUEEZENET)
    if is_published(path, SQUEEZENET):
        raise WeightsError(
            f"{path} is torchvision's SqueezeNet 1.1, a backbone of LPIPS; the feature distance "
            "needs the weights its authors trained in Caffe"
        )
    return SqueezeNetDistance(layers).eval().requires_grad_(requires_grad=False)
