"""The Inception network by whose features FID and KID compare sets of images.

It is the TensorFlow network that the authors of FID used (Szegedy et al., "Rethinking the Inception
Architecture", 2016, as trained in 2015), which differs from torchvision's in its poolings. Its
weights come from a file that the user supplies: `pt_inception-2015-12-05-6726825d.pth` of
pytorch-fid, or torch-fidelity's `weights-inception-2015-12-05-6726825d.pth`, which holds the same
bytes. No other network is taken for it.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.metrics.backbones import frozen, read_tensors
from lidarpainter_models.storage.whole_files import sha256_of

PUBLISHED = "6726825d"
"""First eight digits of the SHA-256 of the file, as they stand in its name."""
NUM_FEATURES = 2048
SIDE_PX = 299
NO_WEIGHTS = "FID and KID need the weights of Inception, which the user supplies: none given"

Pooling = Literal["average", "max"]


class Layer(NamedTuple):
    """A convolution of a branch."""

    name: str
    outputs: int
    kernel: tuple[int, int]
    """Rows and columns."""


Fork = tuple[Layer, ...]
"""Convolutions side by side that end a branch."""


class Convolution(nn.Module):
    """A convolution without bias, its batch normalisation and a rectifier."""

    def __init__(
        self, inputs: int, outputs: int, kernel: tuple[int, int], *, stride: int = 1, pads: bool
    ) -> None:
        super().__init__()
        padding = (kernel[0] // 2, kernel[1] // 2) if pads else (0, 0)
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride=stride, padding=padding, bias=False)
        self.bn = nn.BatchNorm2d(outputs, eps=0.001)

    def forward(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> Float[Tensor, "batch outputs _rows _columns"]:
        """Apply the three."""
        return functional.relu(self.bn(self.conv(features)))


class Mixed(nn.Module):
    """Branches of convolutions side by side, and one of a pooling; their channels are joined."""

    def __init__(
        self,
        inputs: int,
        branches: Sequence[Sequence[Layer | Fork]],
        *,
        pooling: Pooling = "average",
        pooled: int = 0,
    ) -> None:
        """Take the layers of each branch by name; without `pooled` channels the size halves."""
        super().__init__()
        self.branches: list[list[list[str]]] = []
        self.pooling, self.halves = pooling, not pooled
        for branch in branches:
            channels, names = inputs, list[list[str]]()
            for position, step in enumerate(branch):
                fork = (step,) if isinstance(step, Layer) else step
                is_last = self.halves and position == len(branch) - 1
                for name, outputs, kernel in fork:
                    layer = Convolution(
                        channels, outputs, kernel, stride=1 + is_last, pads=not is_last
                    )
                    self.add_module(name, layer)
                names.append([one.name for one in fork])
                channels = fork[-1].outputs
            self.branches.append(names)
        if pooled:
            self.branch_pool = Convolution(inputs, pooled, (1, 1), pads=False)

    def forward(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> Float[Tensor, "batch outputs _rows _columns"]:
        """All branches, then the pooling."""
        found = []
        for branch in self.branches:
            value = features
            for names in branch:
                value = torch.cat([self.get_submodule(name)(value) for name in names], dim=1)
            found.append(value)
        return torch.cat([*found, self._pooled(features)], dim=1)

    def _pooled(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> Float[Tensor, "batch outputs _rows _columns"]:
        if self.halves:
            return functional.max_pool2d(features, 3, stride=2)
        if self.pooling == "max":
            return self.branch_pool(functional.max_pool2d(features, 3, stride=1, padding=1))
        average = functional.avg_pool2d(features, 3, 1, 1, count_include_pad=False)
        return self.branch_pool(average)


_DOUBLE = (
    Layer("branch3x3dbl_1", 64, (1, 1)),
    Layer("branch3x3dbl_2", 96, (3, 3)),
    Layer("branch3x3dbl_3", 96, (3, 3)),
)
"""Two 3x3 convolutions in place of a 5x5 one."""


def _small(inputs: int, pooled: int) -> Mixed:
    """A module of the 35x35 grid."""
    five = (Layer("branch5x5_1", 48, (1, 1)), Layer("branch5x5_2", 64, (5, 5)))
    return Mixed(inputs, [[Layer("branch1x1", 64, (1, 1))], five, _DOUBLE], pooled=pooled)


def _seven(channels: int) -> Mixed:
    """A module of the 17x17 grid, whose 7x7 convolutions are split into rows and columns."""
    once = (
        Layer("branch7x7_1", channels, (1, 1)),
        Layer("branch7x7_2", channels, (1, 7)),
        Layer("branch7x7_3", 192, (7, 1)),
    )
    twice = (
        Layer("branch7x7dbl_1", channels, (1, 1)),
        Layer("branch7x7dbl_2", channels, (7, 1)),
        Layer("branch7x7dbl_3", channels, (1, 7)),
        Layer("branch7x7dbl_4", channels, (7, 1)),
        Layer("branch7x7dbl_5", 192, (1, 7)),
    )
    return Mixed(768, [[Layer("branch1x1", 192, (1, 1))], once, twice], pooled=192)


def _forked(inputs: int, pooling: Pooling) -> Mixed:
    """A module of the 8x8 grid, whose 3x3 convolutions end in rows and columns side by side."""
    once = (
        Layer("branch3x3_1", 384, (1, 1)),
        (Layer("branch3x3_2a", 384, (1, 3)), Layer("branch3x3_2b", 384, (3, 1))),
    )
    twice = (
        Layer("branch3x3dbl_1", 448, (1, 1)),
        Layer("branch3x3dbl_2", 384, (3, 3)),
        (Layer("branch3x3dbl_3a", 384, (1, 3)), Layer("branch3x3dbl_3b", 384, (3, 1))),
    )
    branches = [[Layer("branch1x1", 320, (1, 1))], once, twice]
    return Mixed(inputs, branches, pooling=pooling, pooled=192)


class Inception(nn.Module):
    """Images to the 2,048 features before the classifier."""

    def __init__(self) -> None:
        super().__init__()
        self.Conv2d_1a_3x3 = Convolution(3, 32, (3, 3), stride=2, pads=False)
        self.Conv2d_2a_3x3 = Convolution(32, 32, (3, 3), pads=False)
        self.Conv2d_2b_3x3 = Convolution(32, 64, (3, 3), pads=True)
        self.Conv2d_3b_1x1 = Convolution(64, 80, (1, 1), pads=False)
        self.Conv2d_4a_3x3 = Convolution(80, 192, (3, 3), pads=False)
        self.Mixed_5b = _small(192, 32)
        self.Mixed_5c, self.Mixed_5d = _small(256, 64), _small(288, 64)
        self.Mixed_6a = Mixed(288, [[Layer("branch3x3", 384, (3, 3))], _DOUBLE])
        self.Mixed_6b, self.Mixed_6c, self.Mixed_6d = _seven(128), _seven(160), _seven(160)
        self.Mixed_6e = _seven(192)
        once = (Layer("branch3x3_1", 192, (1, 1)), Layer("branch3x3_2", 320, (3, 3)))
        seven = (
            Layer("branch7x7x3_1", 192, (1, 1)),
            Layer("branch7x7x3_2", 192, (1, 7)),
            Layer("branch7x7x3_3", 192, (7, 1)),
            Layer("branch7x7x3_4", 192, (3, 3)),
        )
        self.Mixed_7a = Mixed(768, [once, seven])
        self.Mixed_7b, self.Mixed_7c = _forked(1280, "average"), _forked(2048, "max")

    def forward(self, images: Float[Tensor, "batch 3 299 299"]) -> Float[Tensor, "batch 2048"]:
        """Features of images with whole numbers from 0 to 255."""
        value = (images - 128) / 128
        for layer in (self.Conv2d_1a_3x3, self.Conv2d_2a_3x3, self.Conv2d_2b_3x3):
            value = layer(value)
        value = functional.max_pool2d(value, 3, stride=2)
        value = self.Conv2d_4a_3x3(self.Conv2d_3b_1x1(value))
        value = functional.max_pool2d(value, 3, stride=2)
        for module in self.children():
            if isinstance(module, Mixed):
                value = module(value)
        return value.mean((2, 3))

    def features_of(
        self, images: Iterable[Float[Tensor, "_height _width 3"]]
    ) -> Float[Tensor, "images 2048"]:
        """Features of images with rgb in 0..1, each brought to 299x299 bytes by bicubic weights.

        neurad-studio does so (`ad_pipeline.py`), but for a rounding: it cuts the fractions of bytes
        off before it resizes. One image is looked at after the other.
        """
        device = self.Conv2d_1a_3x3.conv.weight.device
        found = [self(_as_bytes(image.to(device)))[0] for image in images]
        return torch.stack(found) if found else torch.empty(0, NUM_FEATURES)


def _as_bytes(image: Float[Tensor, "height width 3"]) -> Float[Tensor, "1 3 299 299"]:
    bytes_ = (image.clamp(0, 1) * 255).round().permute(2, 0, 1)[None]
    sized = functional.interpolate(bytes_, (SIDE_PX, SIDE_PX), mode="bicubic", antialias=True)
    return sized.round().clamp(0, 255)


def load_inception(path: Path, device: torch.device | None = None) -> Inception:
    """A frozen network with the published weights; those of the classifier are left out.

    Raises:
        WeightsError: the file is missing, unreadable, or not the published one.
    """
    state = read_tensors(path, "Inception")
    digest = sha256_of(path)
    if not digest.startswith(PUBLISHED):
        raise WeightsError(
            f"{path} is not the published Inception of FID: its SHA-256 begins with "
            f"{digest[:8]}, expected {PUBLISHED} (pt_inception-2015-12-05-{PUBLISHED}.pth)"
        )
    network = frozen(Inception(), state, f"{path} does not hold the Inception of FID")
    return network.to(device)
