"""One training step of the one-step painter at full size, to measure what it costs.

Random weights of the true shapes in bfloat16, a random view, and the loss without LPIPS, whose
weights do not come with the package: so with a discriminator on patches.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from random_diffusion import random_network
from turbo_shapes import SD_TURBO, WholeModel

from lidarpainter_models.painter.augmentation import TrainingBatch
from lidarpainter_models.painter.batches import ConditionBatch
from lidarpainter_models.painter.one_step.architectures import TEXT_TOKENS
from lidarpainter_models.painter.one_step.config import OneStepConfig
from lidarpainter_models.painter.one_step.painter import NUM_WARPS
from lidarpainter_models.painter.one_step.training import OneStepTrainee, OneStepTrainingConfig
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT
from lidarpainter_models.painter.training.checkpoints import TrainingState

_SEED = 0


def build_training_step(
    network: OneStepConfig, height_px: int, width_px: int, architecture: WholeModel = SD_TURBO
) -> Callable[[], float]:
    """A function that takes one step and returns its loss.

    Args:
        network: the wiring.
        height_px: rows of the view, a multiple of 64.
        width_px: columns, too.
        architecture: of the model.
    """
    config = OneStepTrainingConfig(network=network)
    config = replace(config, loss=replace(config.loss, lpips=0.0))
    generator = torch.Generator().manual_seed(_SEED)
    text = torch.randn(TEXT_TOKENS, architecture.text_width, generator=generator)
    model = random_network(network, architecture=architecture, seed=_SEED, has_adapters=True)
    trainee = OneStepTrainee(model, {DEFAULT_PROMPT: text}, config)
    state = TrainingState.start(trainee.trained, trainee.opponent)
    batch = _random_batch(height_px, width_px, generator)

    def step() -> float:
        loss = trainee.learn(batch, step=state.step, share=1.0)["total"]
        for optimiser in state.optimisers.values():
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        state.step += 1
        return loss

    return step


def _random_batch(height_px: int, width_px: int, generator: torch.Generator) -> TrainingBatch:
    def draw(*channels: int) -> torch.Tensor:
        return torch.rand(1, *channels, height_px, width_px, generator=generator)

    ones = torch.ones(1, 1, height_px, width_px)
    conditions = ConditionBatch(
        render=draw(3),
        render_depth_m=10 * ones,
        render_alpha=ones,
        lidar=draw(3),
        lidar_depth_m=10 * ones,
        lidar_hit=ones,
        warp=draw(NUM_WARPS, 3),
        warp_valid=ones.expand(1, NUM_WARPS, height_px, width_px),
    )
    return TrainingBatch(conditions, draw(3), ones[:, 0], (DEFAULT_PROMPT,))
