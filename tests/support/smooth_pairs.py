"""Pairs that a small painter learns from in a moment."""

import hashlib
from dataclasses import replace

import torch
from random_conditions import random_conditions

from lidarpainter_models.painter.examples import PaintingPair
from lidarpainter_models.painter.filters import blur


def smooth_pair(side_px=48, seed=0):
    """A smooth image whose render is noisy and whose LiDAR and warps are true."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.rand(1, 3, side_px, side_px, generator=generator)
    truth = (0.5 + 4 * (blur(noise, sigma_px=4.0)[0] - 0.5)).clamp(0, 1).permute(1, 2, 0)
    old = random_conditions(side_px, side_px, seed=seed)
    shake = 0.3 * (torch.rand(side_px, side_px, 3, generator=generator) - 0.5)
    conditions = replace(
        old,
        render_rgb=(truth + shake).clamp(0, 1),
        render_alpha=torch.ones(side_px, side_px),
        lidar_rgb=truth * old.lidar_hit[..., None],
        warp_rgb=truth * old.warp_valid[..., None],
    )
    everywhere = torch.ones(side_px, side_px, dtype=torch.bool)
    return PaintingPair(conditions=conditions, target_rgb=truth, target_valid=everywhere)


class MemoryPairs:
    """Pairs held in memory."""

    def __init__(self, pairs, label="memory"):
        self.pairs = pairs
        self.digest = hashlib.sha256(label.encode()).hexdigest()

    def __len__(self):
        return len(self.pairs)

    def size_px(self, index):
        return self.pairs[index].conditions.height_width_px

    def read(self, index, window=None):
        pair = self.pairs[index]
        return pair if window is None else pair.cropped(window)

    def describe(self):
        return {"digest": self.digest}
