"""Fronts, knees and bars against cases worked out by hand."""

import math

import pytest

from lidarpainter_models.evaluation.fronts import Spread, beats, knee, paired_gain, pareto_front


def test_the_bar_is_that_of_student():
    spread = Spread.of([1.0, 2.0, 3.0])
    assert spread.mean == pytest.approx(2.0)
    assert spread.half_width == pytest.approx(4.303 / math.sqrt(3), rel=1e-3)
    assert Spread.of([5.0]) == Spread(5.0, math.inf)


def test_pairs_see_what_scenes_hide():
    ours, theirs = [20.5, 30.4, 25.6], [20.0, 30.0, 25.0]
    gain = paired_gain(ours, theirs)
    assert gain.mean == pytest.approx(0.5)
    assert gain.is_sure
    assert not paired_gain([1.0, 2.0], [2.0, 1.0]).is_sure
    assert not paired_gain([2.0], [1.0]).is_sure


def test_the_front_is_what_nothing_beats():
    costs, qualities = [4.0, 1.0, 2.0, 3.0, 2.0], [9.0, 5.0, 8.0, 7.0, 6.0]
    assert pareto_front(costs, qualities) == [1, 2, 0]


def test_the_knee_is_where_the_gain_ends():
    assert knee([10, 20, 40, 80, 160], [20.0, 26.0, 29.0, 29.4, 29.6]) == 2
    assert knee([10, 20, 40], [1.0, 2.0, 3.0]) == 0  # each doubling gives the same
    assert knee([10], [1.0]) == 0


def test_better_counts_beyond_both_bars_only():
    fast, slow = Spread(10, 1), Spread(20, 1)
    assert beats(fast, Spread(30.0, 0.1), slow, Spread(29.0, 0.1))
    assert not beats(fast, Spread(30.0, 1.0), slow, Spread(29.0, 1.0))
    assert not beats(slow, Spread(30.0, 0.1), fast, Spread(29.0, 0.1))
    assert not beats(Spread(10, math.inf), Spread(30.0, 0.1), slow, Spread(29.0, 0.1))
