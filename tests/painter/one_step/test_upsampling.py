"""Doubling by phases gives what doubling and convolving gives."""

import pytest
import torch
from torch import nn

from lidarpainter_models.painter.one_step.assembly import made_lean
from lidarpainter_models.painter.one_step.config import FAST, PAPER
from lidarpainter_models.painter.one_step.upsampling import PhasedUpsampling


def conv_of(in_channels, out_channels, *, bias=True):
    torch.manual_seed(0)
    return nn.Conv2d(in_channels, out_channels, 3, padding=1, bias=bias).requires_grad_(False)


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (2, 3), (8, 8)])
@pytest.mark.parametrize("bias", [True, False])
def test_phases_give_the_doubled_convolution(size, bias):
    conv = conv_of(3, 5, bias=bias).double()
    features = torch.randn(2, 3, *size, generator=torch.Generator().manual_seed(1)).double()
    doubled = nn.functional.interpolate(features, scale_factor=2.0, mode="nearest")
    actual = PhasedUpsampling(conv)(features)
    # weights are summed in float32
    torch.testing.assert_close(actual, conv(doubled), rtol=1e-6, atol=1e-6)


def test_one_pixel_is_worked_by_hand():
    conv = conv_of(1, 1, bias=False)
    conv.weight[:] = torch.arange(9.0).view(1, 1, 3, 3)
    found = PhasedUpsampling(conv)(torch.ones(1, 1, 1, 1))
    # four equal pixels: each sees the 2x2 weights that fall on them
    expected = torch.tensor([[4.0 + 5 + 7 + 8, 3 + 4 + 6 + 7], [1 + 2 + 4 + 5, 0 + 1 + 3 + 4]])
    assert torch.equal(found[0, 0], expected)


@pytest.mark.parametrize("config", [PAPER, FAST])
@torch.no_grad()
def test_a_lean_network_paints_the_same(config, make_network, make_inputs):
    network = make_network(config, has_adapters=True)
    images, text = make_inputs()
    expected = network(images, text)
    actual = made_lean(network)(images, text)
    num_phased = sum(isinstance(module, PhasedUpsampling) for module in network.modules())
    assert num_phased == (6 if config is PAPER else 3)  # TAESD has its own way of doubling
    torch.testing.assert_close(actual, expected, rtol=1e-3, atol=1e-4)
