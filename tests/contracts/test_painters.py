"""What every painter keeps to, learned or not."""

from dataclasses import fields, replace
from functools import cache

import pytest
import torch
from random_conditions import random_conditions
from tiny_diffusion import write_model

from lidarpainter_models.painter.known_painters import PAINTER_NAMES
from lidarpainter_models.painter.protocol import Painter, Painting
from lidarpainter_models.painter.selection import load_painter

MODELS = {"sd-turbo": "one-step"}
"""Painters that need weights of gigabytes, and what they call themselves: a tiny model with random
weights stands in."""
OTHER_SUMS = {"sd-turbo": 2.0**-4}
"""Two threads add up in another order: bfloat16 keeps 8 bits, and random weights amplify the last
one through some forty layers where trained ones damp it."""
FEW_OTHER_SUMS = 2 / 255
"""The same for trained weights; rules give equal bits anyway."""


@pytest.fixture(scope="module")
def painters(tmp_path_factory):
    @cache
    def load(name):
        if name in MODELS:
            folder = write_model(tmp_path_factory.mktemp("models") / name)
            return load_painter(f"{folder}:with-reference")
        return load_painter(name)

    return load


@pytest.fixture(params=PAINTER_NAMES)
def painter(request, painters):
    return painters(request.param)


@pytest.fixture(autouse=True)
def threads():
    """As many as before, whatever a test sets."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def assert_sound(painting: Painting, size: tuple[int, int]) -> None:
    assert painting.rgb.shape == (*size, 3)
    assert painting.confidence.shape == size
    for values in (painting.rgb, painting.confidence):
        assert values.dtype == torch.float32
        assert bool(((values >= 0) & (values <= 1)).all())
    assert 0 <= painting.kept_share <= 1


@pytest.mark.parametrize("name", PAINTER_NAMES)
def test_a_painter_says_its_name(name, painters):
    painter = painters(name)
    assert isinstance(painter, Painter)
    assert painter.name == MODELS.get(name, name)


@pytest.mark.parametrize("size", [(1, 1), (7, 9), (64, 64), (70, 130)])
def test_a_view_of_any_size_keeps_it(painter, size):
    assert_sound(painter.paint(random_conditions(*size)), size)


@pytest.mark.parametrize("num_sources", [0, 1, 3])
def test_any_number_of_recorded_images_may_be_near(painter, num_sources):
    assert_sound(painter.paint(random_conditions(24, 40, num_sources)), (24, 40))


def test_equal_conditions_give_equal_images_and_stay_as_they_were(painter):
    conditions, same = random_conditions(), random_conditions()
    first = painter.paint(conditions)
    painter.paint(random_conditions(seed=1))  # a painter remembers nothing of other views
    again = painter.paint(conditions)
    assert torch.equal(first.rgb, again.rgb)
    assert torch.equal(first.confidence, again.confidence)
    for field in fields(conditions):
        value = getattr(conditions, field.name)
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, getattr(same, field.name)), field.name


@pytest.mark.parametrize("name", PAINTER_NAMES)
def test_two_threads_paint_what_one_does(name, painters):
    painter, conditions = painters(name), random_conditions(64, 96)
    alone = painter.paint(conditions)
    torch.set_num_threads(2)
    together = painter.paint(conditions)
    atol = OTHER_SUMS.get(name, FEW_OTHER_SUMS)
    torch.testing.assert_close(together.rgb, alone.rgb, rtol=0, atol=atol)
    torch.testing.assert_close(together.confidence, alone.confidence, rtol=0, atol=atol)
    assert float((together.rgb - alone.rgb).abs().mean()) < 1 / 255


def test_a_view_that_no_lidar_point_hits_is_painted(painter):
    conditions = random_conditions(24, 40)
    blind = replace(
        conditions,
        lidar_rgb=torch.zeros_like(conditions.lidar_rgb),
        lidar_depth_m=torch.zeros_like(conditions.lidar_depth_m),
        lidar_hit=torch.zeros_like(conditions.lidar_hit),
    )
    assert_sound(painter.paint(blind), (24, 40))


def test_a_view_of_which_nothing_is_known_is_painted(painter):
    """No LiDAR, no recorded image, no Gaussian in sight."""
    conditions = random_conditions(24, 40, num_sources=0)
    nothing = {
        field.name: torch.zeros_like(getattr(conditions, field.name))
        for field in fields(conditions)
        if isinstance(getattr(conditions, field.name), torch.Tensor)
    }
    painting = painter.paint(replace(conditions, **nothing))
    assert_sound(painting, (24, 40))
