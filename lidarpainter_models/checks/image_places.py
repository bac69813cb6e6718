"""Whether images show what stands before their cameras: not another's, turned over or mirrored.

The depth edges before a camera lie on the edges of its own images (`checks.depth_edges`). Where
they lie better on another's, and the other's on its, files were named the wrong way round; where
they lie better on the same images turned over, the camera hangs upside down, or a flag that said so
was lost.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from lidarpainter_models.checks.calibration import why_untold
from lidarpainter_models.checks.depth_edges import EdgeImage, SceneEdges, edge_scores
from lidarpainter_models.checks.verdicts import Verdict

MIN_LEAD = 0.08
"""By which another's images must fit better, in deviations of edge strength.

Of the cameras of PandaSet 002 own images lead by 0.17 to 0.66. Over the same images turned over or
mirrored those of PandaSet, KITTI, a night and streets lead by 0.08 to 0.71, where a degree has four
pixels or more; at 1.7 they lead by -0.1 to 0.1.
"""
_OVER = {"turned upside down": (-1, -1), "mirrored": (1, -1), "flipped": (-1, 1)}
"""Steps through the rows and the columns of an image."""


def check_image_places(edges: SceneEdges) -> tuple[Verdict, str]:
    """Whether the images of a camera are its own, and the right way up."""
    untold = {name: why for name in edges.images if (why := why_untold(edges, name)) is not None}
    over = [
        f"{name}'s look {way}"
        for name, images in edges.images.items()
        for way, steps in _OVER.items()
        if name not in untold
        and _lead(images, [_stepped(image, *steps) for image in images]) < -MIN_LEAD
    ]
    if over:
        return "fail", f"depth edges fit other images better: {', '.join(over)}"
    verdict, said = _check_swapped(edges)
    untried = [
        f"whether {name}'s are turned over was not checked ({untold[name]})" for name in untold
    ]
    return verdict, "; ".join([said, *untried])


def _stepped(image: EdgeImage, rows: int, columns: int) -> EdgeImage:
    turned = {
        kind: np.ascontiguousarray(strength[::rows, ::columns])
        for kind, strength in image.strengths.items()
    }
    return replace(image, strengths=turned)


def _check_swapped(edges: SceneEdges) -> tuple[Verdict, str]:
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
