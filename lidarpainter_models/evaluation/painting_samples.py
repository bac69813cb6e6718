"""Images of what a painter makes of some pairs, for a person to look at."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from lidarpainter_models.painter.examples import PairSource
from lidarpainter_models.painter.protocol import Painter

NUM_SAMPLES = 4


def painting_samples(
    painter: Painter, sources: Mapping[str, PairSource]
) -> Float[Tensor, "height width 3"]:
    """A row per pair: render, LiDAR, painted, true image; the pairs lie evenly over all sources.

    Raises:
        DataError: a pair is damaged.
    """
    known = [(source, index) for source in sources.values() for index in range(len(source))]
    count = min(NUM_SAMPLES, len(known))
    chosen = [known[rank * len(known) // count] for rank in range(count)]
    rows = [_row(painter, source, index) for source, index in chosen]
    width_px = max(row.shape[1] for row in rows)
    return torch.cat([_widened(row, width_px) for row in rows])


def _row(painter: Painter, source: PairSource, index: int) -> Float[Tensor, "height width 3"]:
    pair = source.read(index)
    seen = pair.conditions
    painted = painter.paint(seen).rgb
    return torch.cat([seen.render_rgb, seen.lidar_rgb, painted, pair.target_rgb], dim=1)


def _widened(row: Float[Tensor, "height width 3"], width_px: int) -> Float[Tensor, "height wide 3"]:
    return functional.pad(row, (0, 0, 0, width_px - row.shape[1]))
