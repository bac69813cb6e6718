"""A short training of a small one-step network that processes of their own can run."""

from dataclasses import replace

import torch
import torch.distributed
from quiet_augmentation import QUIET
from random_diffusion import random_network
from tiny_diffusion import TEXT_WIDTH, TINY

from lidarpainter_models.painter.adversarial import DiscriminatorConfig
from lidarpainter_models.painter.losses import PaperLossWeights
from lidarpainter_models.painter.one_step.training import (
    OneStepTrainee,
    OneStepTrainingConfig,
    train_one_step,
)
from lidarpainter_models.training_data.pairs import PairFolder

CONTEST = OneStepTrainingConfig(
    augmentation=replace(QUIET, crop_px=64),
    loss=PaperLossWeights(lpips=0, adversarial=0.1),
    discriminator=DiscriminatorConfig(width=4, num_scales=1),
    penalty_every_steps=2,
    recomputes=False,
    half_precision=False,
    steps=4,
    accumulated_batches=1,
    learning_rate=1e-3,
    warm_up_steps=1,
    average_decay=0.5,
    log_every_steps=1,
    checkpoint_every_s=0.0,
)


def train_small(pairs, config, checkpoints=None):
    """Train a small network on a folder of pairs; returns the weights by name and the record."""
    torch.set_num_threads(1)
    network = random_network(
        config.network, architecture=TINY, dtype=torch.float32, has_adapters=True
    )
    text = torch.randn(77, TEXT_WIDTH, generator=torch.Generator().manual_seed(0))
    trainee = OneStepTrainee(network, {"clear": text}, config)
    record = train_one_step(trainee, [PairFolder(pairs)], checkpoint_folder=checkpoints)
    return {name: one.detach().clone() for name, one in trainee.trained.items()}, record
