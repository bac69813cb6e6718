"""Settings of a short training of a small one-step network."""

from dataclasses import replace

from quiet_augmentation import QUIET

from lidarpainter_models.painter.adversarial import DiscriminatorConfig
from lidarpainter_models.painter.losses import PaperLossWeights
from lidarpainter_models.painter.one_step.training import OneStepTrainingConfig

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
