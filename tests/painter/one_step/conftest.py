"""Small one-step networks with random weights."""

import pytest
import torch
from random_diffusion import random_network
from tiny_diffusion import TEXT_WIDTH, TINY


@pytest.fixture
def make_network():
    """A small network in float32, with adapters if asked."""

    def make(config, **options):
        return random_network(config, architecture=TINY, dtype=torch.float32, **options)

    return make


@pytest.fixture
def make_inputs():
    """Random images and an encoded prompt."""

    def make(num_inputs=2, batch=1, height_px=64, width_px=128, seed=0):
        generator = torch.Generator().manual_seed(seed)
        images = torch.rand(num_inputs, batch, 3, height_px, width_px, generator=generator)
        return images, torch.randn(batch, 77, TEXT_WIDTH, generator=generator)

    return make
