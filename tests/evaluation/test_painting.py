"""Figures of painters on pairs, against answers worked out by hand."""

import math
from dataclasses import replace

import pytest
import torch

from lidarpainter_models.errors import DataError
from lidarpainter_models.evaluation.painting import confidence_auc, outside_hull, score_painter
from lidarpainter_models.painter.baselines import UnpaintedPainter
from lidarpainter_models.painter.protocol import Painting

SIDE_PX = 20
PIXELS = SIDE_PX**2


def grey(value=0.5):
    return torch.full((SIDE_PX, SIDE_PX, 3), value)


def two_rows_off():
    """0.2 too bright in a tenth of the pixels: 10 log10(1 / (0.1 * 0.04)) = 23.98 dB."""
    image = grey()
    image[:2] += 0.2
    return image


class FixedPainter:
    """Gives the same image and confidence to every view."""

    name = "fixed"

    def __init__(self, rgb, confidence):
        self.painting = Painting(rgb=rgb, confidence=confidence)

    def paint(self, _conditions):
        return self.painting


@pytest.fixture
def two_cases(make_flat_pair, listed_pairs):
    """A damaged render under a true warp, and one that is 0.05 too bright everywhere."""
    return {
        "rows": listed_pairs(make_flat_pair(two_rows_off(), warp=grey())),
        "light": listed_pairs(make_flat_pair(grey(0.55))),
    }


def test_the_figures_of_two_cases_are_those_worked_out_by_hand(two_cases):
    scores = score_painter(UnpaintedPainter(), two_cases)
    rows, light = scores.sources["rows"], scores.sources["light"]
    assert rows.input.psnr == pytest.approx(-10 * math.log10(0.004), abs=1e-3)
    assert light.input.psnr == pytest.approx(-10 * math.log10(0.0025), abs=1e-3)
    assert scores.total.input.psnr == pytest.approx((rows.input.psnr + light.input.psnr) / 2)
    # the true warp halves the error of the rows; where there is none, the render stays
    assert rows.warp_mean.psnr == pytest.approx(30.0, abs=1e-3)
    assert light.warp_mean.psnr == light.input.psnr
    assert (rows.damaged_share, light.damaged_share) == (0.1, 0.0)
    assert rows.input.damaged_psnr == pytest.approx(-10 * math.log10(0.04), abs=1e-3)
    assert light.input.damaged_psnr is None
    # undamaged pixels are pooled: 360 without error and 400 of 0.0025
    pooled = 400 * 0.0025 / 760
    assert scores.total.input.undamaged_psnr == pytest.approx(-10 * math.log10(pooled), abs=1e-3)
    assert scores.total.num_pairs == 2
    assert scores.total.input.feature_distance is None


def test_painting_nothing_scores_like_the_input(two_cases):
    scores = score_painter(UnpaintedPainter(), two_cases)
    assert scores.painter == "none"
    assert scores.total.painted == scores.total.input
    assert scores.total.painted.outside_hull == 0
    assert scores.total.cpu_ms_per_frame >= 0


def test_a_perfect_image_has_no_error(two_cases):
    painter = FixedPainter(grey(), torch.ones(SIDE_PX, SIDE_PX))
    total = score_painter(painter, two_cases).total
    assert total.painted.psnr == math.inf
    assert total.painted.ssim == pytest.approx(1.0, abs=1e-6)
    assert total.confidence_auc is None  # nothing is wrong, so nothing could be foretold


def test_unknown_pixels_never_count(make_flat_pair, listed_pairs):
    pair = make_flat_pair(two_rows_off())
    known = torch.ones_like(pair.target_valid)
    known[:2] = False
    pairs = {"pairs": listed_pairs(replace(pair, target_valid=known))}
    total = score_painter(UnpaintedPainter(), pairs).total
    assert total.input.psnr == math.inf
    assert total.damaged_share == 0
    assert total.input.ssim == pytest.approx(1.0, abs=1e-6)


def test_colours_nobody_showed_nearby_are_counted(make_flat_pair, listed_pairs):
    pair = make_flat_pair(grey())
    invented = grey()
    invented[3, 4] += 0.06
    invented[9, 9, 1] -= 0.06
    invented[15, 2] += 0.04  # within the margin
    painter = FixedPainter(invented, torch.ones(SIDE_PX, SIDE_PX))
    total = score_painter(painter, {"pairs": listed_pairs(pair)}).total
    assert total.painted.outside_hull == 2 / PIXELS
    assert outside_hull(invented, pair.conditions).nonzero().tolist() == [[3, 4], [9, 9]]


@pytest.mark.parametrize(
    ("row", "is_outside"), [(10, False), (14, False), (15, True), (6, False), (5, True)]
)
def test_the_hull_reaches_four_pixels(make_flat_pair, row, is_outside):
    render = grey()
    render[10, 10] = 1.0
    painted = grey()
    painted[row, 10] = 0.9
    found = outside_hull(painted, make_flat_pair(render).conditions)
    assert bool(found[row, 10]) is is_outside


def test_valid_warps_and_lidar_hits_belong_to_the_hull_and_others_do_not(make_flat_pair):
    painted = grey(0.9)
    for known in (make_flat_pair(grey(), warp=grey(0.9)), make_flat_pair(grey(), lidar=grey(0.9))):
        assert not bool(outside_hull(painted, known.conditions).any())
    hidden = make_flat_pair(grey(), warp=grey(0.9)).conditions
    hidden = replace(hidden, warp_valid=torch.zeros_like(hidden.warp_valid))
    assert bool(outside_hull(painted, hidden).all())
    dark = make_flat_pair(grey()).conditions  # unhit LiDAR is black, which is no colour
    assert bool(outside_hull(grey(0.1), dark).all())


def test_a_confidence_that_knows_the_error_is_perfect(two_cases):
    confidence = torch.ones(SIDE_PX, SIDE_PX)
    confidence[:2] = 0.2
    painter = FixedPainter(two_rows_off(), confidence)
    assert score_painter(painter, two_cases).total.confidence_auc == 1.0
    wrong_way = FixedPainter(two_rows_off(), 1 - confidence)
    assert score_painter(wrong_way, two_cases).total.confidence_auc == 0.0


def test_a_constant_confidence_foretells_nothing(two_cases):
    painter = FixedPainter(two_rows_off(), torch.full((SIDE_PX, SIDE_PX), 0.7))
    assert score_painter(painter, two_cases).total.confidence_auc == 0.5


def test_the_area_under_the_curve_is_that_worked_out_by_hand():
    # wrong at 0 and 2, right at 1, 2 and 3: of six pairs four are in order and one is tied
    right = torch.tensor([0.0, 1, 1, 1], dtype=torch.float64)
    wrong = torch.tensor([1.0, 0, 1, 0], dtype=torch.float64)
    assert confidence_auc(right, wrong) == pytest.approx(4.5 / 6)


def test_the_feature_distance_compares_all_three_images(two_cases):
    def distance(image, truth):
        return (image - truth).abs().mean()

    total = score_painter(UnpaintedPainter(), two_cases, feature_distance=distance).total
    assert total.input.feature_distance == pytest.approx((0.02 + 0.05) / 2, abs=1e-6)
    assert total.warp_mean.feature_distance == pytest.approx((0.01 + 0.05) / 2, abs=1e-6)


def test_progress_is_told_after_every_pair(two_cases):
    heard = []
    score_painter(
        UnpaintedPainter(), two_cases, progress=lambda done, total: heard.append((done, total))
    )
    assert heard == [(1, 2), (2, 2)]


def test_nothing_to_judge_by_is_one_clear_line(make_flat_pair, listed_pairs):
    pair = make_flat_pair(grey())
    unknown = replace(pair, target_valid=torch.zeros_like(pair.target_valid))
    for sources in ({}, {"empty": listed_pairs()}, {"unknown": listed_pairs(unknown)}):
        with pytest.raises(DataError) as caught:
            score_painter(UnpaintedPainter(), sources)
        assert "\n" not in str(caught.value)


def test_gains_are_differences_of_the_figures_they_name(two_cases):
    painter = FixedPainter(grey(0.51), torch.ones(SIDE_PX, SIDE_PX))
    rows = score_painter(painter, two_cases).sources["rows"]
    gains = rows.gains_db
    # everything is 0.01 off now: 40 dB, against 23.98 of the input and 30 of the mean
    assert gains.over_input == pytest.approx(40 + 10 * math.log10(0.004), abs=1e-2)
    assert gains.over_warp_mean == pytest.approx(10.0, abs=1e-2)
    assert gains.damaged == pytest.approx(40 + 10 * math.log10(0.04), abs=1e-2)
    assert gains.undamaged == -math.inf  # what was perfect no longer is
    light = score_painter(UnpaintedPainter(), two_cases).sources["light"].gains_db
    assert (light.over_input, light.undamaged) == (0, 0)
    assert light.damaged is None


def test_the_share_that_was_kept_is_averaged_over_pairs(two_cases):
    painter = FixedPainter(grey(), torch.ones(SIDE_PX, SIDE_PX))
    assert score_painter(painter, two_cases).total.kept_share == 0
    painter.painting = replace(painter.painting, kept_share=0.75)
    assert score_painter(painter, two_cases).total.kept_share == 0.75
