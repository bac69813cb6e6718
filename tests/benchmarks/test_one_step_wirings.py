"""The wirings that are timed against each other are one and the same painter."""

import torch
from one_step_wirings import build_wiring
from tiny_diffusion import TINY


def test_plain_and_lean_paint_the_same_image():
    images = torch.rand(2, 1, 3, 64, 128, generator=torch.Generator().manual_seed(0))
    plain, lean, tiny = (
        build_wiring(wiring, TINY)(images) for wiring in ("plain", "lean", "taesd")
    )
    assert plain.shape == lean.shape == tiny.shape == images[0].shape
    # bfloat16 throughout, and a step at t = 999 that multiplies its rounding by 14.6
    assert float((plain - lean).abs().mean()) < 0.05 * float(plain.std())
    assert float((plain - tiny).abs().mean()) > 0.2 * float(plain.std())
