"""Flat pairs whose figures can be worked out by hand."""

import pytest
import torch
from smooth_pairs import MemoryPairs

from lidarpainter_models.painter.examples import PaintingPair
from lidarpainter_models.painter.protocol import PaintingConditions

SIDE_PX = 20


def flat_pair(render_rgb, *, truth=0.5, warp=None, lidar=None):
    """An image of one colour; without a warp or LiDAR none is valid anywhere."""
    flat = torch.full((SIDE_PX, SIDE_PX, 3), truth)
    nowhere = torch.zeros(SIDE_PX, SIDE_PX, dtype=torch.bool)
    conditions = PaintingConditions(
        render_rgb=render_rgb,
        render_depth_m=torch.ones(SIDE_PX, SIDE_PX),
        render_alpha=torch.ones(SIDE_PX, SIDE_PX),
        lidar_rgb=torch.zeros_like(flat) if lidar is None else lidar,
        lidar_depth_m=torch.zeros(SIDE_PX, SIDE_PX),
        lidar_hit=nowhere if lidar is None else ~nowhere,
        warp_rgb=(torch.zeros_like(flat) if warp is None else warp)[None],
        warp_valid=(nowhere if warp is None else ~nowhere)[None],
    )
    return PaintingPair(conditions=conditions, target_rgb=flat, target_valid=~nowhere)


@pytest.fixture
def make_flat_pair():
    return flat_pair


@pytest.fixture
def listed_pairs():
    return lambda *pairs: MemoryPairs(pairs)
