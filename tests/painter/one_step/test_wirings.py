"""The wirings that are timed against each other are one and the same painter."""

import pytest
from tiny_diffusion import TINY

from lidarpainter_models.painter.one_step.wirings import build_wiring


def test_plain_and_lean_paint_the_same_image(make_inputs):
    images, _ = make_inputs()
    plain, lean, tiny = (
        build_wiring(wiring, TINY)(images) for wiring in ("plain", "lean", "taesd")
    )
    assert plain.shape == lean.shape == tiny.shape == images[0].shape
    # bfloat16 throughout, and a step at t = 999 that multiplies its rounding by 14.6
    assert float((plain - lean).abs().mean()) < 0.05 * float(plain.std())
    assert float((plain - tiny).abs().mean()) > 0.2 * float(plain.std())


@pytest.mark.slow
def test_the_full_size_benchmark_stays_near_its_goals():
    from tasks.painter.benchmark import compare_wirings

    found = compare_wirings(288, 512, rounds=1)
    # the goals are 1.4 and 5; other work on the machine moves them by a fifth
    assert found["lean"]["times_faster"] >= 1.2
    assert found["taesd"]["times_faster"] >= 4.5
    assert max(found[one]["peak_bytes"] for one in ("lean", "taesd")) <= 4e9
