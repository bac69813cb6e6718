"""Small random pairs, and folders of them, for tests that train and judge painters."""

import torch

from lidarpainter_models.painter.examples import PaintingPair
from lidarpainter_models.painter.protocol import PaintingConditions
from lidarpainter_models.training_data.pairs import PairWriter

HEIGHT_PX, WIDTH_PX = 32, 48


def random_pair(seed, height_px=HEIGHT_PX, width_px=WIDTH_PX):
    """A random image, a render of it with noise, and half of it in LiDAR and a warp."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(*shape, generator=generator)

    truth = draw(height_px, width_px, 3)
    hit, valid = draw(height_px, width_px) < 0.5, draw(1, height_px, width_px) < 0.5
    everywhere = torch.ones(height_px, width_px)
    conditions = PaintingConditions(
        render_rgb=(truth + 0.4 * draw(height_px, width_px, 3) - 0.2).clamp(0, 1),
        render_depth_m=10 * everywhere,
        render_alpha=everywhere,
        lidar_rgb=truth * hit[..., None],
        lidar_depth_m=10.0 * hit,
        lidar_hit=hit,
        warp_rgb=truth[None] * valid[..., None],
        warp_valid=valid,
        reference_rgb=draw(height_px, width_px, 3),
    )
    return PaintingPair(conditions=conditions, target_rgb=truth, target_valid=everywhere > 0)


def write_pairs(folder, frames, dataset="pandaset", sequence="002", **size_px):
    """Store a pair of each frame."""
    writer = PairWriter(folder)
    for frame in frames:
        provenance = {"dataset": dataset, "sequence": sequence, "target": [frame, "front"]}
        writer.add(f"pair-{frame}", random_pair(frame, **size_px), provenance)
