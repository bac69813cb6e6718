"""Edge agreement is one for smooth changes of light and near chance for another place."""

import pytest
import torch

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.metrics import edges
from lidarpainter_models.metrics.edges import edge_agreement, supported_pixels

HEIGHT_PX, WIDTH_PX = 120, 160


def blocks(seed=0, side_px=10):
    """Squares of random grey: every edge is known."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(HEIGHT_PX // side_px, WIDTH_PX // side_px, generator=generator)
    grey = coarse.repeat_interleave(side_px, 0).repeat_interleave(side_px, 1)
    return grey[..., None].expand(-1, -1, 3).contiguous()


EVERYWHERE = torch.full((HEIGHT_PX, WIDTH_PX), 10.0)


def f1_of(styled, clear, depth_m=EVERYWHERE):
    return edge_agreement(styled, clear, depth_m).f1


def test_a_image_agrees_with_itself():
    assert f1_of(blocks(), blocks()) == 1


def test_smooth_fading_keeps_the_structure():
    fade = torch.linspace(1.0, 0.2, WIDTH_PX)[None, :, None]
    assert f1_of(blocks() * fade + 0.8 * (1 - fade), blocks()) > 0.9


def test_another_image_is_near_chance(monkeypatch):
    monkeypatch.setattr(edges, "TOLERANCE_PX", 1)
    other = torch.roll(blocks(5), (5, 5), (0, 1))
    assert f1_of(other, blocks()) < 0.4


@pytest.mark.parametrize(("shift_px", "is_found"), [(1, True), (5, False)])
def test_edges_are_found_again_within_the_tolerance(shift_px, is_found):
    moved = torch.roll(blocks(), shift_px, dims=1)
    assert (f1_of(moved, blocks()) > 0.9) is is_found


def test_a_blank_image_keeps_nothing():
    assert f1_of(torch.full((HEIGHT_PX, WIDTH_PX, 3), 0.5), blocks()) == 0


def test_only_pixels_near_a_hit_that_is_not_too_far_are_judged():
    depth_m = torch.zeros(HEIGHT_PX, WIDTH_PX)
    depth_m[40, 40], depth_m[80, 80] = 10.0, 90.0
    judged = supported_pixels(depth_m)
    assert bool(judged[40, 43])
    assert not bool(judged[40, 44])
    assert not bool(judged[80, 80])
    depth_m = torch.zeros(HEIGHT_PX, WIDTH_PX)
    depth_m[:, : WIDTH_PX // 2] = 10.0
    half_wrong = blocks()
    half_wrong[:, WIDTH_PX // 2 + 15 :] = blocks(7)[:, WIDTH_PX // 2 + 15 :]
    assert f1_of(half_wrong, blocks(), depth_m) > 0.95
    assert f1_of(half_wrong, blocks()) < 0.9


def test_nothing_to_judge_gives_no_figure():
    assert edge_agreement(blocks(), blocks(), torch.zeros(HEIGHT_PX, WIDTH_PX)) is None
    blank = torch.full((HEIGHT_PX, WIDTH_PX, 3), 0.5)
    assert edge_agreement(blocks(), blank, EVERYWHERE) is None


def test_sizes_that_do_not_fit_are_refused():
    with pytest.raises(ShapeError, match="one size"):
        edge_agreement(blocks(), blocks(), torch.zeros(3, 3))
