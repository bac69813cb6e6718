"""Whether the images of two cameras have changed places.

The depth edges before one camera lie on the edges of its own images (`checks.depth_edges`). Where
they lie better on another's, and the other's on its, files were named the wrong way round.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from lidarpainter_models.checks.depth_edges import EdgeImage, SceneEdges, edge_scores
from lidarpainter_models.checks.verdicts import Verdict

MIN_LEAD = 0.08
"""By which another's images must fit better, in deviations of edge strength.

Of the cameras of PandaSet 002 own images lead by 0.17 to 0.66.
"""


def check_swapped_images(edges: SceneEdges) -> tuple[Verdict, str]:
    """Whether the images of two cameras of one size fit each other's place better."""
    images = edges.images
    pairs = [
        (first, second)
        for first, second in combinations(images, 2)
        if _size(images[first]) == _size(images[second])
    ]
    if not pairs:
        return "ok", "no two cameras of one size"
    leads = {
        (first, second): (
            _lead(images[first], images[second]),
            _lead(images[second], images[first]),
        )
        for first, second in pairs
    }
    swapped = [" and ".join(pair) for pair, both in leads.items() if max(both) < -MIN_LEAD]
    if swapped:
        return "fail", f"the images of {', '.join(swapped)} look as if they had changed places"
    least = min(max(both) for both in leads.values())
    return "ok", f"of each two cameras' images one set fits its own place better, by {least:.2f}"


def _lead(own: Sequence[EdgeImage], other: Sequence[EdgeImage]) -> float:
    """How much better a camera's own images fit its depth edges than another's."""
    theirs = {image.frame_index: image.strengths for image in other}
    both = [image for image in own if image.frame_index in theirs]
    lent = [replace(image, strengths=theirs[image.frame_index]) for image in both]
    (own_score,), (lent_score,) = (edge_scores(images, np.zeros((1, 3))) for images in (both, lent))
    return float(own_score - lent_score)


def _size(images: Sequence[EdgeImage]) -> tuple[int, ...] | None:
    """Of images of which there are some."""
    return images[0].strengths["across"].shape if images else None
