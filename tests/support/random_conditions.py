"""Seeded noise as what a painter is given."""

import torch

from lidarpainter_models.painter.protocol import PaintingConditions


def random_conditions(height_px=24, width_px=40, num_sources=2, seed=0, prompt="clear"):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(*shape, generator=generator)

    hit = draw(height_px, width_px) < 0.4
    valid = draw(num_sources, height_px, width_px) < 0.6
    return PaintingConditions(
        render_rgb=draw(height_px, width_px, 3),
        render_depth_m=50 * draw(height_px, width_px),
        render_alpha=draw(height_px, width_px),
        lidar_rgb=draw(height_px, width_px, 3) * hit[..., None],
        lidar_depth_m=50 * draw(height_px, width_px) * hit,
        lidar_hit=hit,
        warp_rgb=draw(num_sources, height_px, width_px, 3) * valid[..., None],
        warp_valid=valid,
        reference_rgb=draw(height_px, width_px, 3),
        prompt=prompt,
    )
