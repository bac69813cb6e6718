"""SqueezeNet feature distance: a perceptual distance whose weights the user supplies.

The network is SqueezeNet 1.1 (Iandola et al., 2016) up to its last fire module, sliced as in
Zhang et al. (2018). The distance is theirs without the learned linear heads: at seven depths the
channel-normalised features are compared and the squared differences averaged over positions and
summed. It is *not* LPIPS, and is never reported under that name.
"""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lidarpainter_models.errors import WeightsError

CHANNEL_MEAN_BGR = (103.939, 116.779, 123.68)
"""Subtracted from BGR pictures in 0..255 before the first convolution."""
FIRE_CHANNELS = {
    3: (64, 16, 64),
    4: (128, 16, 64),
    6: (128, 32, 128),
    7: (256, 32, 128),
    9: (256, 48, 192),
    10: (384, 48, 192),
    11: (384, 64, 256),
    12: (512, 64, 256),
}
"""Layer index to (input, squeeze, expand) channels."""
COMPARED_LAYERS = (1, 4, 7, 9, 10, 11, 12)


class Fire(nn.Module):
    """Squeeze to few channels, then expand by 1x1 and 3x3 convolutions side by side."""

    def __init__(self, channels_in: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(channels_in, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(
        self, features: Float[Tensor, "batch channels height width"]
    ) -> Float[Tensor, "batch more height width"]:
        """Apply the module."""
        squeezed = functional.relu(self.squeeze(features))
        expanded = [self.expand1x1(squeezed), self.expand3x3(squeezed)]
        return functional.relu(torch.cat(expanded, dim=1))


class SqueezeNetDistance(nn.Module):
    """Distance between two pictures in the feature spaces of SqueezeNet 1.1."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Conv2d(3, 64, 3, stride=2), nn.ReLU()]
        for index in range(2, 13):
            fire = FIRE_CHANNELS.get(index)
            layers.append(Fire(*fire) if fire else nn.MaxPool2d(3, 2, ceil_mode=True))
        self.layers = nn.Sequential(*layers)

    def features(
        self, rgb: Float[Tensor, "height width 3"]
    ) -> list[Float[Tensor, "1 channels rows columns"]]:
        """Channel-normalised features at the compared depths."""
        bgr = rgb.flip(-1) * 255 - torch.tensor(CHANNEL_MEAN_BGR, device=rgb.device)
        value = bgr.permute(2, 0, 1)[None]
        found = []
        for index, layer in enumerate(self.layers):
            value = layer(value)
            if index in COMPARED_LAYERS:
                found.append(functional.normalize(value, dim=1, eps=1e-10))
        return found

    def forward(
        self, picture: Float[Tensor, "height width 3"], truth: Float[Tensor, "height width 3"]
    ) -> Float[Tensor, ""]:
        """The distance; 0 for equal pictures."""
        pairs = zip(self.features(picture), self.features(truth), strict=True)
        return torch.stack([(a - b).square().sum(1).mean() for a, b in pairs]).sum()


def load_squeezenet_distance(path: Path) -> SqueezeNetDistance:
    """Read SqueezeNet 1.1 feature weights (torchvision key names, `features.` optional).

    Raises:
        WeightsError: the file is missing, unreadable, or holds another network.
    """
    try:
        state = torch.load(path, weights_only=True, map_location="cpu")
    except FileNotFoundError:
        raise WeightsError(f"no SqueezeNet weights at {path}") from None
    except Exception as error:  # noqa: BLE001 - torch.load raises many types on damaged files
        raise WeightsError(f"{path} is no readable weights file: {type(error).__name__}") from None
    if not isinstance(state, dict):
        raise WeightsError(f"{path} holds a {type(state).__name__}, expected a dict of tensors")
    named = {f"layers.{key.removeprefix('features.')}": value for key, value in state.items()}
    network = SqueezeNetDistance()
    wanted = network.state_dict()
    found = {key: value for key, value in named.items() if key in wanted}
    if any(key not in found or found[key].shape != wanted[key].shape for key in wanted):
        raise WeightsError(f"{path} does not hold the features of SqueezeNet 1.1")
    network.load_state_dict(found)
    return network.eval().requires_grad_(requires_grad=False)
