"""Discriminators that tell true images from painted ones, and the losses of both sides.

Where weights of a frozen network are at hand, small heads judge its features at several depths
(Kumari et al., "Ensembling Off-the-shelf Models for GAN Training", 2022); otherwise patch
discriminators look at the image at several scales (Wang et al., pix2pixHD, 2018). Every layer is
spectrally normalised (Miyato et al., 2018), the losses are hinges (Lim and Ye, 2017), and the
gradient on true images is penalised (R1, Mescheder et al., 2018).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.parametrizations import spectral_norm

from lidarpainter_models.errors import ConfigError

Discriminator = Callable[
    [Float[Tensor, "batch 3 height width"]], list[Float[Tensor, "batch 1 _ _"]]
]
"""Logits per scale or depth: above 0 where an image looks true."""

LEAK = 0.2
"""Slope of the rectifiers below zero."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscriminatorConfig:
    """The shape of a discriminator."""

    width: int = 64
    """Channels of the first layer of a patch discriminator, and of the hidden layer of a head."""
    num_layers: int = 3
    """Layers that halve the resolution at every scale; three see patches of 70 pixels."""
    num_scales: int = 2
    """The image itself, half of it, ..."""

    def __post_init__(self) -> None:
        for name in ("width", "num_layers", "num_scales"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be positive, got {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True, eq=False)
class FrozenFeatures:
    """A network that is not trained, as a discriminator sees it."""

    extract: Callable[[Float[Tensor, "batch 3 height width"]], Sequence[Tensor]]
    """Features at several depths of images with rgb in [0, 1]; gradients pass to the images."""
    channels: tuple[int, ...]
    """Of each depth."""


class PatchDiscriminator(nn.Module):
    """Judges overlapping patches of an image at several scales."""

    def __init__(self, config: DiscriminatorConfig) -> None:
        super().__init__()
        self.scales = nn.ModuleList(_patch_layers(config) for _ in range(config.num_scales))

    def forward(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> list[Float[Tensor, "batch 1 _ _"]]:
        """A map of logits per scale."""
        views, found = 2 * images - 1, []
        for scale in self.scales:
            found.append(scale(views))
            views = functional.avg_pool2d(views, 2)
        return found


class FeatureDiscriminator(nn.Module):
    """Judges the features of a frozen network at several depths; only the heads are trained."""

    def __init__(self, features: FrozenFeatures, config: DiscriminatorConfig) -> None:
        super().__init__()
        self.features = features
        self.heads = nn.ModuleList(
            nn.Sequential(
                spectral_norm(nn.Conv2d(channels, config.width, 1)),
                nn.LeakyReLU(LEAK),
                spectral_norm(nn.Conv2d(config.width, 1, 3, padding=1)),
            )
            for channels in features.channels
        )

    def forward(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> list[Float[Tensor, "batch 1 _ _"]]:
        """A map of logits per depth."""
        seen = self.features.extract(images)
        return [head(values) for head, values in zip(self.heads, seen, strict=True)]


def discriminator_loss(
    discriminator: Discriminator,
    true: Float[Tensor, "batch 3 height width"],
    painted: Float[Tensor, "batch 3 height width"],
    *,
    penalty_weight: float,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Hinge and gradient penalty; the painter gets no gradient from it.

    `penalty_weight` is gamma of R1, half of which counts; 0 saves its second backward pass.
    """
    hinge = discriminator_hinge_loss(discriminator(true), discriminator(painted.detach()))
    if penalty_weight == 0:
        return hinge, hinge.new_zeros(())
    return hinge, gradient_penalty(discriminator, true)


def discriminator_hinge_loss(
    true_logits: Sequence[Float[Tensor, "batch 1 _ _"]],
    painted_logits: Sequence[Float[Tensor, "batch 1 _ _"]],
) -> Float[Tensor, ""]:
    """Mean of max(0, 1 - D(true)) + max(0, 1 + D(painted)), averaged over the scales."""
    pairs = zip(true_logits, painted_logits, strict=True)
    return torch.stack(
        [
            functional.relu(1 - true).mean() + functional.relu(1 + painted).mean()
            for true, painted in pairs
        ]
    ).mean()


def generator_hinge_loss(
    painted_logits: Sequence[Float[Tensor, "batch 1 _ _"]],
) -> Float[Tensor, ""]:
    """Mean of -D(painted), averaged over the scales."""
    return -torch.stack([logits.mean() for logits in painted_logits]).mean()


def gradient_penalty(
    discriminator: Discriminator, true: Float[Tensor, "batch 3 height width"]
) -> Float[Tensor, ""]:
    """R1: the squared length of the gradient of D at true images, averaged over the batch.

    D of an image is its mean logit, averaged over the scales.
    """
    images = true.detach().requires_grad_(True)
    verdicts = torch.stack([logits.flatten(1).mean(dim=1) for logits in discriminator(images)])
    (gradient,) = torch.autograd.grad(verdicts.mean(dim=0).sum(), images, create_graph=True)
    return gradient.square().flatten(1).sum(dim=1).mean()


def _patch_layers(config: DiscriminatorConfig) -> nn.Sequential:
    layers: list[nn.Module] = []
    channels_in = 3
    for index in range(config.num_layers):
        channels = config.width * min(2**index, 8)
        layers.append(spectral_norm(nn.Conv2d(channels_in, channels, 4, stride=2, padding=1)))
        layers.append(nn.LeakyReLU(LEAK))
        channels_in = channels
    layers.append(spectral_norm(nn.Conv2d(channels_in, 1, 4, stride=1, padding=2)))
    return nn.Sequential(*layers)
