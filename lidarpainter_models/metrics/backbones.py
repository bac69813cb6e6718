"""Classification networks up to their last convolution, for distances in feature space.

VGG-16 (Simonyan and Zisserman, 2015), the one-tower AlexNet of Krizhevsky (2014) and SqueezeNet 1.1
(Iandola et al., 2016), with the parameter names that torchvision gives them. Weights come from a
file that the user supplies; which published file it is, its SHA-256 says.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.storage.whole_files import sha256_of

Network = TypeVar("Network", bound=nn.Module)
VGG16_CHANNELS = ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
"""Channels and convolutions of every block; a max-pool stands between blocks."""
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
"""SqueezeNet's layer index to (input, squeeze, expand) channels."""


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


class FeatureStack(nn.Sequential):
    """Layers of a network, some of whose outputs are compared."""

    def __init__(self, layers: list[nn.Module], compared: tuple[int, ...]) -> None:
        super().__init__(*layers)
        self.compared = compared

    def compared_features(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> list[Float[Tensor, "batch channels rows columns"]]:
        """What the compared layers say, scaled to a unit vector in every position."""
        value, found = images, []
        for index, layer in enumerate(self):
            value = layer(value)
            if index in self.compared:
                found.append(functional.normalize(value, dim=1, eps=1e-10))
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Backbone:
    """One of the three networks."""

    name: str
    build: Callable[[], FeatureStack]
    channels: tuple[int, ...]
    """Channels of the compared layers, by which heads are matched to a backbone."""
    published: tuple[str, ...]
    """First eight digits of the SHA-256 of torchvision's files, as they stand in their names."""


def squeezenet_stack() -> FeatureStack:
    """SqueezeNet 1.1, compared as in Zhang et al. (2018)."""
    layers: list[nn.Module] = [nn.Conv2d(3, 64, 3, stride=2), nn.ReLU()]
    for index in range(2, 13):
        fire = FIRE_CHANNELS.get(index)
        layers.append(Fire(*fire) if fire else nn.MaxPool2d(3, 2, ceil_mode=True))
    return FeatureStack(layers, (1, 4, 7, 9, 10, 11, 12))


def vgg16_stack() -> FeatureStack:
    """VGG-16, compared after the last rectifier of every block."""
    layers: list[nn.Module] = []
    compared, channels_in = [], 3
    for channels, count in VGG16_CHANNELS:
        for _ in range(count):
            layers += [nn.Conv2d(channels_in, channels, 3, padding=1), nn.ReLU()]
            channels_in = channels
        compared.append(len(layers) - 1)
        layers.append(nn.MaxPool2d(2, 2))
    return FeatureStack(layers[:-1], tuple(compared))


def alexnet_stack() -> FeatureStack:
    """AlexNet, compared after every rectifier."""
    layers: list[nn.Module] = [nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU()]
    layers += [nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, padding=2), nn.ReLU()]
    layers += [nn.MaxPool2d(3, 2), nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()]
    layers += [nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()]
    layers += [nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()]
    return FeatureStack(layers, (1, 4, 7, 9, 11))


BACKBONES = (
    Backbone(
        name="VGG-16", build=vgg16_stack, channels=(64, 128, 256, 512, 512), published=("397923af",)
    ),
    Backbone(
        name="AlexNet",
        build=alexnet_stack,
        channels=(64, 192, 384, 256, 256),
        published=("7be5be79", "4df8aa71"),
    ),
    Backbone(
        name="SqueezeNet 1.1",
        build=squeezenet_stack,
        channels=(64, 128, 256, 384, 384, 512, 512),
        published=("b8a52dc0", "f364aa15"),
    ),
)
SQUEEZENET = BACKBONES[2]


def read_tensors(path: Path, what: str) -> dict[str, Tensor]:
    """The tensors of a weights file by name; nothing else of it is unpickled.

    Raises:
        WeightsError: the file is missing, unreadable, or no dict of tensors.
    """
    try:
        state = torch.load(path, weights_only=True, map_location="cpu")
    except FileNotFoundError:
        raise WeightsError(f"no {what} weights at {path}") from None
    except Exception as error:  # noqa: BLE001 - torch.load raises many types on damaged files
        raise WeightsError(f"{path} is no readable weights file: {type(error).__name__}") from None
    if not isinstance(state, Mapping) or not all(isinstance(v, Tensor) for v in state.values()):
        raise WeightsError(f"{path} holds a {type(state).__name__}, expected a dict of tensors")
    return {str(key): value for key, value in state.items()}


def is_published(path: Path, backbone: Backbone) -> bool:
    """Whether a file is torchvision's own, by its SHA-256."""
    return sha256_of(path).startswith(backbone.published)


def load_stack(path: Path, backbone: Backbone) -> FeatureStack:
    """A frozen network with weights under torchvision's names, `features.` optional.

    Tensors of the classifier are left out.

    Raises:
        WeightsError: the file is missing, unreadable, or holds another network.
    """
    state = read_tensors(path, backbone.name)
    named = {key.removeprefix("features."): value for key, value in state.items()}
    return frozen(backbone.build(), named, f"{path} does not hold the features of {backbone.name}")


def frozen(network: Network, tensors: Mapping[str, Tensor], complaint: str) -> Network:
    """A network with those of the tensors that it has by name, in place; not to be trained.

    Raises:
        WeightsError: a tensor is missing or has another shape; begins with the complaint.
    """
    wanted = {n: t for n, t in network.state_dict().items() if "num_batches" not in n}
    for name, tensor in wanted.items():
        found = tuple(tensors[name].shape) if name in tensors else "none"
        if found != tuple(tensor.shape):
            raise WeightsError(
                f"{complaint}: tensor {name!r} has shape {found}, expected {tuple(tensor.shape)}"
            )
    network.load_state_dict({name: tensors[name].float() for name in wanted}, strict=False)
    return network.eval().requires_grad_(requires_grad=False)


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
