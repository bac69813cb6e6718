"""Batches drawn ahead by other processes are those that would have been drawn here."""

from functools import partial

import pytest
import torch
from quiet_augmentation import QUIET
from strict_device import NAME, strict_device

from lidarpainter_models.errors import DataError
from lidarpainter_models.painter.augmentation import draw_batch
from lidarpainter_models.painter.training.batch_stream import batches_in_order


def draw_from(sources, number):
    if number == 7:
        raise DataError("pair 7 is damaged")
    generator = torch.Generator().manual_seed(number)
    return draw_batch(sources, [1.0], batch_size=2, num_warps=2, config=QUIET, generator=generator)


@pytest.fixture
def draw(make_pair, memory_pairs):
    return partial(draw_from, [memory_pairs([make_pair(48, seed) for seed in range(3)])])


def test_every_device_learns_from_the_same_batches(draw):
    ahead = batches_in_order(draw, strict_device(), first=1, every=2)
    here = batches_in_order(draw, torch.device("cpu"), first=1, every=2)
    for _ in range(3):
        found, expected = next(ahead), next(here)
        assert found.target.device.type == NAME
        assert torch.equal(found.target.cpu(), expected.target)
        assert torch.equal(found.conditions.warp.cpu(), expected.conditions.warp)


def test_a_batch_that_cannot_be_drawn_is_one_line_when_its_turn_comes(draw):
    ahead = batches_in_order(draw, strict_device(), first=6, every=1)
    next(ahead)
    with pytest.raises(DataError, match=r"^pair 7 is damaged$"):
        next(ahead)
