"""Painters without learning."""

import pytest
import torch

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.painter.known_painters import PAINTER_NAMES
from lidarpainter_models.painter.selection import load_painter


def test_none_gives_the_render_back(make_conditions):
    conditions = make_conditions()
    assert torch.equal(load_painter("none").paint(conditions).rgb, conditions.render_rgb)


def test_overlay_shows_lidar_where_it_hits(make_conditions):
    conditions = make_conditions()
    painting = load_painter("overlay").paint(conditions)
    hit = conditions.lidar_hit
    assert torch.equal(painting.rgb[hit], conditions.lidar_rgb[hit])
    assert torch.equal(painting.rgb[~hit], conditions.render_rgb[~hit])
    assert bool((painting.confidence[hit] == 1).all())


def test_warp_averages_what_is_valid(make_conditions):
    conditions = make_conditions(num_sources=2)
    painting = load_painter("warp").paint(conditions)
    both = conditions.warp_valid.all(dim=0)
    first = conditions.warp_valid[0] & ~conditions.warp_valid[1]
    neither = ~conditions.warp_valid.any(dim=0)
    mean = (conditions.render_rgb + conditions.warp_rgb.sum(dim=0)) / 3
    torch.testing.assert_close(painting.rgb[both], mean[both])
    pair = (conditions.render_rgb + conditions.warp_rgb[0]) / 2
    torch.testing.assert_close(painting.rgb[first], pair[first])
    assert torch.equal(painting.rgb[neither], conditions.render_rgb[neither])
    assert bool((painting.confidence[neither] == 0).all())


def test_unknown_painter_is_one_line():
    with pytest.raises(WeightsError, match="no painter 'nanno'") as caught:
        load_painter("nanno")
    assert "\n" not in str(caught.value)
    assert all(name in str(caught.value) for name in PAINTER_NAMES)
