"""The wirings that are timed against each other are one and the same painter."""

import pytest
import torch
from bench_one_step import compare_wirings
from one_step_wirings import build_wiring
from tiny_diffusion import TINY

from lidarpainter_models.painter.precision import faster_type


def test_plain_and_lean_paint_the_same_image():
    images = torch.rand(2, 1, 3, 64, 128, generator=torch.Generator().manual_seed(0))
    plain, lean, tiny = (
        build_wiring(wiring, TINY)(images) for wiring in ("plain", "lean", "taesd")
    )
    assert plain.shape == lean.shape == tiny.shape == images[0].shape
    # bfloat16 throughout, and a step at t = 999 that multiplies its rounding by 14.6
    assert float((plain - lean).abs().mean()) < 0.05 * float(plain.std())
    assert float((plain - tiny).abs().mean()) > 0.2 * float(plain.std())


@pytest.mark.slow
def test_the_full_size_benchmark_stays_near_its_goals():
    if faster_type(torch.device("cpu")) != torch.bfloat16:
        pytest.skip("this CPU emulates bfloat16: a view at full size takes it an hour")
    found = compare_wirings(288, 512, rounds=1)
    # the goals are 1.4 and 5; other work on the machine moves them by a fifth
    assert found["lean"]["times_faster"] >= 1.2
    assert found["taesd"]["times_faster"] >= 4.5
    assert max(found[one]["peak_bytes"] for one in ("lean", "taesd")) <= 4e9
