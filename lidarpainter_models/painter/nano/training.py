"""Train the small painter on harvested pairs, from nothing or from weights (`painter.training`)."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lidarpainter_models.errors import ConfigError, TrainingError
from lidarpainter_models.painter.augmentation import TrainingBatch
from lidarpainter_models.painter.batches import ConditionBatch
from lidarpainter_models.painter.examples import PairSource
from lidarpainter_models.painter.known_painters import DIGEST_LENGTH
from lidarpainter_models.painter.losses import (
    Images,
    LossTerms,
    Mask,
    absolute_loss,
    agreement_mask,
    as_numbers,
    gradient_loss,
    masked_mean,
    refuse_negative,
    squared_loss,
    structure_loss,
    weighed,
)
from lidarpainter_models.painter.nano.network import CELL_PX, NanoConfig, NanoNetwork, NanoOutput
from lidarpainter_models.painter.nano.painter import NanoPainter
from lidarpainter_models.painter.nano.weights import save_weights
from lidarpainter_models.painter.training.checkpoints import training_digest
from lidarpainter_models.painter.training.job import TrainingJob
from lidarpainter_models.painter.training.loop import Told, run_training
from lidarpainter_models.painter.training.settings import TrainingConfig, check_prompts


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
    image: Images, before: Sequence[Images], target: Images, mask: Mask
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


CPU = torch.device("cpu")
ALIVE_AFTER_STEPS = 1000
"""From here on a network that says the same in every pixel counts as dead."""
LEAST_SPREAD = 1e-3
"""Deviation of the expected log error over pixels under which it says the same everywhere."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NanoTrainingConfig(TrainingConfig):
    """How the small painter is trained."""

    network: NanoConfig = field(default_factory=NanoConfig)
    loss: NanoLossWeights = field(default_factory=NanoLossWeights)
    steps: int = 20_000
    batch_size: int = 6
    learning_rate: float = 2e-3
    warm_up_steps: int = 200
    weight_decay: float = 1e-4

    def __post_init__(self) -> None:
        TrainingConfig.__post_init__(self)
        check_prompts(self.network.prompts)

    def to_dict(self) -> dict[str, Any]:
        """The settings as JSON types."""
        return asdict(self) | {"network": self.network.to_dict()}


class NanoTrainee:
    """The small network in training: all of its weights change."""

    opponent: nn.Module | None = None

    def __init__(self, network: NanoNetwork, config: NanoTrainingConfig) -> None:
        self.network = network.train()
        self.config = config
        self.num_warps = config.network.num_sources
        self.prompts = config.network.prompts
        self.trained: Mapping[str, nn.Parameter] = dict(network.named_parameters())

    def learn(
        self,
        batch: TrainingBatch,
        *,
        step: int,  # noqa: ARG002 - every step is alike
        share: float,
    ) -> dict[str, float]:
        """Add the gradients of a batch.

        Returns the losses, and as `spread` the deviation over pixels of the expected log error.
        """
        output = self.network(
            batch.conditions, batch.prompts, half_precision=self.config.half_precision
        )
        terms = painting_loss(
            output,
            batch.conditions,
            batch.target,
            batch.target_valid,
            self.config.loss,
            restyled=batch.restyled,
            sees_render="render" in self.config.network.inputs,
        )
        (share * terms["total"]).backward()
        return as_numbers(terms) | {"spread": float(output.log_error.detach().std())}

    def check(self, step: int, means: Mapping[str, float]) -> None:
        """Refuse a network that says the same everywhere.

        Raises:
            TrainingError: it does.
        """
        if step > ALIVE_AFTER_STEPS and means["spread"] < LEAST_SPREAD:
            raise TrainingError(
                f"the network says the same in every pixel at step {step}: the training stops, "
                "its last checkpoint is kept; start again with a lower learning_rate"
            )


def train_nano(
    sources: Sequence[PairSource],
    config: NanoTrainingConfig,
    *,
    start: NanoNetwork | None = None,
    checkpoint_folder: Path | None = None,
    progress: Told | None = None,
    device: torch.device = CPU,
) -> tuple[NanoNetwork, dict[str, Any]]:
    """Train the small painter, continuing from a checkpoint of the same training if there is one.

    Without a `start` it begins with nothing; `progress` is called at every entry of the history.

    Returns:
        The network with the averaged weights, and how it came to be as JSON types.

    Raises:
        DataError: no pairs, or a damaged pair.
        ConfigError: shares that do not fit the sources, first weights of another network, or a
            checkpoint of another training.
        TrainingError: the loss is no longer finite or the network has died; the last checkpoint
            stays as it was.
    """
    known = None if start is None else start.state_dict()
    digest = training_digest(config.to_dict(), [source.digest for source in sources], known)
    trainee = NanoTrainee(first_network(config, start).to(device), config)
    record = run_training(
        trainee,
        sources,
        config,
        digest=digest,
        checkpoint_folder=checkpoint_folder,
        progress=progress,
    )
    return trainee.network.eval(), record


def first_network(config: NanoTrainingConfig, start: NanoNetwork | None) -> NanoNetwork:
    """First weights: those given, or such as follow from the seed alone.

    Raises:
        ConfigError: the weights given belong to a network that differs by more than prompts.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        shape = config.network
        network = NanoNetwork(shape) if start is None else with_more_prompts(start, shape)
    # torch's stub lacks memory_format
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


@torch.no_grad()
def with_more_prompts(network: NanoNetwork, config: NanoConfig) -> NanoNetwork:
    """A network of the given shape that paints every known prompt as before, bit for bit.

    New prompts start as the first; where the network had no tint, its head starts without a
    preference for it.

    Raises:
        ConfigError: the shapes differ by more than prompts.
    """
    known = network.config
    num_known = len(known.prompts)
    differs = replace(known, prompts=config.prompts) != config
    if differs or config.prompts[:num_known] != known.prompts:
        raise ConfigError(
            f"cannot start a network {config.to_dict()} from the weights of {known.to_dict()}"
        )
    extended = NanoNetwork(config)
    state = extended.state_dict()
    num_old, num_new = len(known.candidates), len(config.candidates)
    for name, tensor in network.state_dict().items():
        if name in ("prompt.weight", "style.weight"):
            state[name][:num_known] = tensor
            state[name][num_known:] = tensor[0]
        elif name.startswith("head.") and num_new > num_old:
            cells = CELL_PX**2
            state[name][: num_old * cells] = tensor[: num_old * cells]
            state[name][num_old * cells : num_new * cells] = 0
            state[name][num_new * cells :] = tensor[num_old * cells :]
        else:
            state[name] = tensor
    extended.load_state_dict(state)
    return extended


class NanoJob(TrainingJob):
    """The small painter as a training job."""

    name = "nano"

    def __init__(
        self, config: NanoTrainingConfig, first: NanoPainter | None, device: torch.device
    ) -> None:
        """Take the recipe, the painter to go on from, and where to train."""
        self._config, self._device = config, device
        self._start: NanoNetwork | None = None
        if first is not None:
            self._start, self.first_provenance = first.network, first.provenance

    @property
    def inputs(self) -> dict[str, str]:
        """See `TrainingJob`."""
        if self._start is None:
            return {}
        known = training_digest({}, [], self._start.state_dict())
        return {"first weights": known[:DIGEST_LENGTH]}

    def train(self, sources: Sequence[PairSource], folder: Path, told: Told) -> dict[str, Any]:
        """See `TrainingJob`."""
        self._trained, record = train_nano(
            sources,
            self._config,
            start=self._start,
            checkpoint_folder=folder,
            progress=told,
            device=self._device,
        )
        return record

    def save(self, path: Path, *, licence: str, provenance: dict[str, Any]) -> None:
        """See `TrainingJob`."""
        save_weights(self._trained, path, licence=licence, provenance=provenance)
