"""Train the one-step network: adapters, first layer, skips and fusion; the model stays frozen.

The loss is the paper's (`painter.losses`). Frozen weights may lie in bfloat16; those that change
are float32, under autocast. The U-Net and the autoencoder compute their inner activations anew in
the backward pass, which saves most of the memory. `painter.training` has the loop.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.adversarial import (
    DiscriminatorConfig,
    FeatureDiscriminator,
    FrozenFeatures,
    PatchDiscriminator,
    discriminator_loss,
)
from lidarpainter_models.painter.augmentation import AugmentationConfig, TrainingBatch
from lidarpainter_models.painter.examples import PairSource
from lidarpainter_models.painter.losses import (
    BatchDistance,
    PaperLossWeights,
    as_numbers,
    known_image,
    paper_loss,
)
from lidarpainter_models.painter.one_step.assembly import is_adapted, trained_in_float32
from lidarpainter_models.painter.one_step.autoencoder import SkipAutoencoder
from lidarpainter_models.painter.one_step.config import OneStepConfig
from lidarpainter_models.painter.one_step.network import OneStepNetwork
from lidarpainter_models.painter.one_step.painter import NUM_WARPS, STRIDE_PX, painter_inputs
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT
from lidarpainter_models.painter.training.checkpoints import training_digest
from lidarpainter_models.painter.training.loop import ALONE, Told, run_training
from lidarpainter_models.painter.training.processes import Processes
from lidarpainter_models.painter.training.settings import TrainingConfig, check_prompts


@dataclass(frozen=True, slots=True, kw_only=True)
class OneStepTrainingConfig(TrainingConfig):
    """How the one-step network is trained; rates and decay are pix2pix-turbo's."""

    network: OneStepConfig = field(default_factory=OneStepConfig)
    prompts: tuple[str, ...] = (DEFAULT_PROMPT,)
    """What it learns: the first restores, the others are styles."""
    augmentation: AugmentationConfig = field(
        default_factory=lambda: AugmentationConfig(crop_px=256)
    )
    """Windows are multiples of 64 px; the paper's 512 need pairs at least as large."""
    loss: PaperLossWeights = field(default_factory=PaperLossWeights)
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    penalty_weight: float = 1.0
    """Gamma of R1, half of which counts."""
    penalty_every_steps: int = 16
    """Steps from one gradient penalty to the next, which counts for all of them."""
    recomputes: bool = True
    """Compute activations anew in the backward pass: less memory, a third more time."""
    steps: int = 20_000
    batch_size: int = 1
    accumulated_batches: int = 4
    learning_rate: float = 5e-6
    warm_up_steps: int = 500
    weight_decay: float = 1e-2

    def __post_init__(self) -> None:
        TrainingConfig.__post_init__(self)
        check_prompts(self.prompts)
        if self.augmentation.crop_px % STRIDE_PX:
            raise ConfigError(
                f"the one-step painter needs crop_px in multiples of {STRIDE_PX}, got "
                f"{self.augmentation.crop_px}"
            )
        if self.penalty_every_steps < 1 or not self.penalty_weight >= 0:
            raise ConfigError("penalty_every_steps must be positive, penalty_weight not negative")

    def to_dict(self) -> dict[str, Any]:
        """The settings as JSON types."""
        return asdict(self) | {"network": self.network.to_dict(), "prompts": list(self.prompts)}


@dataclass(frozen=True, kw_only=True, eq=False)
class Judges:
    """Frozen networks that the loss looks through; their weights are user-supplied."""

    lpips: BatchDistance | None = None
    features: FrozenFeatures | None = None
    """For a discriminator on features; without, it looks at patches of the image."""

    def check(self, weights: PaperLossWeights) -> None:
        """Refuse a loss that needs a network which is not there.

        Raises:
            ConfigError: LPIPS counts and is not given; it is never left out unasked.
        """
        if weights.lpips > 0 and self.lpips is None:
            raise ConfigError(
                f"the loss weighs LPIPS by {weights.lpips} but has no weights for it: give its "
                "backbone and heads, or set training.loss.lpips=0"
            )


class OneStepTrainee:
    """The one-step network in training, and its discriminator if the loss has one."""

    num_warps = NUM_WARPS

    def __init__(
        self,
        network: OneStepNetwork,
        texts: Mapping[str, Float[Tensor, "tokens features"]],
        config: OneStepTrainingConfig,
        judges: Judges | None = None,
    ) -> None:
        """Take a network with adapters; it is made ready for training here, in place.

        `texts` holds every prompt of the recipe.

        Raises:
            ConfigError: a loss without what it weighs.
        """
        judges = judges or Judges()
        judges.check(config.loss)
        self.network = network
        self.config = config
        self.judges = judges
        self.prompts: tuple[str, ...] = config.prompts
        self.device = network.denoiser.timestep.device
        self.texts = {prompt: texts[prompt].to(self.device) for prompt in config.prompts}
        self.trained: Mapping[str, nn.Parameter] = made_trainable(network, config)
        self.opponent = _opponent(config, judges, self.device)

    def learn(self, batch: TrainingBatch, *, step: int, share: float) -> dict[str, float]:
        """Add the gradients of a batch to those of the network and of the discriminator.

        `gradient_penalty` counts for the steps that have none, so its mean is right.
        """
        image = self._painted(batch)
        if self.opponent is not None:
            self.opponent.requires_grad_(False)
        terms = paper_loss(
            image,
            batch.target,
            batch.target_valid,
            self.config.loss,
            lpips=self.judges.lpips,
            discriminator=self.opponent,
        )
        (share * terms["total"]).backward()
        if self.opponent is None:
            return as_numbers(terms)
        self.opponent.requires_grad_(True)
        seen = known_image(image.detach(), batch.target, batch.target_valid)
        every = self.config.penalty_every_steps
        weight = 0.0 if step % every else every * self.config.penalty_weight
        hinge, penalty = discriminator_loss(
            self.opponent, batch.target, seen, penalty_weight=weight
        )
        (share * (hinge + 0.5 * weight * penalty)).backward()
        return as_numbers(terms) | {
            "discriminator": float(hinge.detach()),
            "gradient_penalty": every * float(penalty.detach()),
        }

    def _painted(self, batch: TrainingBatch) -> Float[Tensor, "batch 3 height width"]:
        images, masks = painter_inputs(batch.conditions, self.config.network)
        text = torch.stack([self.texts[prompt] for prompt in batch.prompts])
        with torch.autocast(
            self.device.type, dtype=torch.bfloat16, enabled=self.config.half_precision
        ):
            return self.network(images, text, masks)

    def check(self, step: int, means: Mapping[str, float]) -> None:
        """A frozen model cannot die; that the loss is a number is checked at every step."""


def made_trainable(
    network: OneStepNetwork, config: OneStepTrainingConfig
) -> dict[str, nn.Parameter]:
    """Freeze a network but for what is trained, which becomes float32; returns that by name.

    The network stays in evaluation mode, where nothing in it is random.
    """
    network.eval().requires_grad_(False)
    trained = trained_in_float32(network)
    for parameter in trained.values():
        parameter.requires_grad_(True)
    for module in network.modules():
        if is_adapted(module):
            adapted: Any = module
            # peft would widen every activation to float32 only for autocast to narrow it again
            adapted.cast_input_dtype_enabled = not config.half_precision
    if config.recomputes:
        unet: Any = network.denoiser.unet
        unet.enable_gradient_checkpointing()
        if isinstance(network.autoencoder, SkipAutoencoder):
            network.autoencoder.is_checkpointed = True
    # torch's stub lacks memory_format
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return trained


def _opponent(
    config: OneStepTrainingConfig, judges: Judges, device: torch.device
) -> nn.Module | None:
    """A discriminator whose first weights follow from the seed."""
    if config.loss.adversarial == 0:
        return None
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        if judges.features is None:
            return PatchDiscriminator(config.discriminator).to(device)
        return FeatureDiscriminator(judges.features, config.discriminator).to(device)


def train_one_step(
    trainee: OneStepTrainee,
    sources: Sequence[PairSource],
    *,
    checkpoint_folder: Path | None = None,
    progress: Told | None = None,
    processes: Processes = ALONE,
) -> dict[str, Any]:
    """Train a network in place; afterwards it holds the averaged weights.

    Returns:
        How it was trained, as JSON types.

    Raises:
        DataError: no pairs, or a damaged pair.
        ConfigError: shares that do not fit the sources, or a checkpoint of another training.
        TrainingError: the loss is no longer finite; the last checkpoint stays as it was.
    """
    network, config, opponent = trainee.network, trainee.config, trainee.opponent
    first = dict(network.named_parameters())
    settings = config.to_dict() | {"processes": processes.count}
    digest = training_digest(settings, [source.digest for source in sources], first)
    record = run_training(
        trainee,
        sources,
        config,
        digest=digest,
        checkpoint_folder=checkpoint_folder,
        progress=progress,
        processes=processes,
    )
    network.requires_grad_(False)
    return record | {"discriminator": None if opponent is None else type(opponent).__name__}
