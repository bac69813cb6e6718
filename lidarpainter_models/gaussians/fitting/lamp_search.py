"""Find the lamps that go on and off in a recording, by what a scene without them cannot show.

A fit that is well on its way shows every place in its mean colour. Where a place is brighter than
that in some images and darker in all others, always by the same, something went on and off: a brake
lamp, an indicator, a signal. Errors of geometry and what changes with the point of view have many
levels, not two; shadows and people that pass are wide, and lamps are small.
"""

from collections.abc import Sequence
from itertools import groupby, product

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.fitting.images import FitImage
from lidarpainter_models.gaussians.fitting.lamp_images import (
    LEAST_PX,
    Levels,
    Look,
    series,
    two_levels,
    with_measured_lamps,
)
from lidarpainter_models.gaussians.model.blinking import Blinking
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.geometry.cameras import Camera

_Box = tuple[int, Tensor, Tensor]
"""A body, and the lower and upper corner in cells."""

CELL_M = 0.2
"""Places are cubes of this side: about a lamp."""
MOST_SIDE_M = 1.2
"""A lamp is no larger than this along any axis of its body."""
LEAST_MEAN_PX = 2.0
"""On average over the images that see it, a lamp has this many."""
LEAST_CHANGE = 0.12
"""Least change of a lamp from off to on, in the channel that changes most; images are 0 to 1."""
LEAST_EXPLAINED = 0.97
"""Share of a lamp's change over time that two levels explain. On PandaSet 002 a signal that
flashes has 0.99, what is next 0.966 (docs/decisions/lamps.md)."""
CANDIDATE_CHANGE, CANDIDATE_EXPLAINED = 0.1, 0.85
"""Least change, and share explained, of a single cube that may be part of a lamp."""
AROUND_CELLS, MOST_AROUND = 3, 0.4
"""What is around a lamp, within so many cells of it, changes by less than this share of its change:
shadows and people that pass are wide."""
STRETCH = 32
"""Images of one camera that are compared at a time: a lamp is passed, and it changes, in less. What
they say of all places takes no more memory than a step of the fit."""
CELLS_AT_ONCE = 16_384


def with_lamps_found(
    scene: GaussianScene, images: Sequence[FitImage], cameras: Sequence[Camera], most: int
) -> GaussianScene:
    """The scene with lamps, their Gaussians as dark as they are off; itself where none blinks.

    Args:
        scene: as fitted without lamps.
        images: what was recorded.
        cameras: where each image was taken from, as far as is known.
        most: images to look through; where there are more, evenly chosen ones of each camera.
            Of those that show what is found, twice as many are looked at once more.
    """
    looks = [Look(image, camera) for image, camera in zip(images, cameras, strict=True)]
    looks.sort(key=lambda look: (look.image.camera_name, look.image.timestamp_ns))
    gaussians = GaussianSet(**scene.gaussians.columns())
    scene = scene.with_gaussians(gaussians)
    cells = torch.column_stack([gaussians.body_index, (gaussians.means / CELL_M).floor()]).long()
    cells, cell_of_row = torch.unique(cells, dim=0, return_inverse=True)
    parts: set[int] = set()
    for stretch in _stretches(looks, most):
        parts.update(_lamp_cells(scene, stretch, cells, cell_of_row))
    if not parts:
        return scene
    lamps = _boxes(cells[torch.tensor(sorted(parts), device=cells.device)])
    return with_measured_lamps(scene, lamps, looks, 2 * most) if len(lamps) else scene


def _stretches(looks: Sequence[Look], most: int) -> list[list[Look]]:
    """Images that are compared with one another: of one camera, in order of time."""
    stride = max(-(-len(looks) // max(most, 1)), 1)
    found = []
    for _, of_camera in groupby(looks, key=lambda look: look.image.camera_name):
        taken = list(of_camera)[::stride]
        found += [taken[first : first + STRETCH] for first in range(0, len(taken), STRETCH)]
    return found


def _lamp_cells(
    scene: GaussianScene,
    looks: Sequence[Look],
    cells: Int[Tensor, "cells 4"],
    cell_of_row: Int[Tensor, " gaussians"],
) -> list[int]:
    """The cells that go on and off together with their neighbours, as one stretch shows."""
    pixels, error = series(scene, looks, cell_of_row, len(cells))
    may_be = torch.cat(
        [
            (levels.explained >= CANDIDATE_EXPLAINED) & (levels.change >= CANDIDATE_CHANGE)
            for some in zip(pixels.split(CELLS_AT_ONCE), error.split(CELLS_AT_ONCE), strict=True)
            for levels in [two_levels(*some)]
        ]
    )
    rows = may_be.nonzero()[:, 0]
    if not len(rows):
        return []
    groups = torch.tensor(_neighbours(cells[rows]), device=pixels.device)
    of_group = torch.full((len(cells),), -1, device=pixels.device)
    of_group[rows] = groups
    grouped = [
        values.new_zeros(int(groups.max()) + 1, *values.shape[1:]).index_add(
            0, groups, values[rows]
        )
        for values in (pixels, error)
    ]
    levels = two_levels(*grouped)
    found = _are_lamps(grouped[0], levels).nonzero()[:, 0].tolist()
    lamps = [
        own.nonzero()[:, 0]
        for group in found
        for own in [of_group == group]
        if _stands_out(cells, own, pixels, error, levels.is_high[group])
    ]
    return torch.cat([torch.zeros(0, dtype=torch.int64), *(lamp.cpu() for lamp in lamps)]).tolist()


def _are_lamps(pixels: Float[Tensor, "places images"], levels: Levels) -> Bool[Tensor, " places"]:
    is_seen = pixels >= LEAST_PX
    mean_px = torch.where(is_seen, pixels, 0.0).sum(dim=1) / is_seen.sum(dim=1).clamp(min=1)
    is_clear = (levels.explained >= LEAST_EXPLAINED) & (levels.change >= LEAST_CHANGE)
    return is_clear & (mean_px >= LEAST_MEAN_PX)


def _stands_out(
    cells: Int[Tensor, "cells 4"],
    own: Bool[Tensor, " cells"],
    pixels: Float[Tensor, "cells images"],
    error: Float[Tensor, "cells images 3"],
    is_high: Bool[Tensor, " images"],
) -> bool:
    """Whether some cells of a body change much more than what is around them."""
    low, high = cells[own].amin(dim=0), cells[own].amax(dim=0)
    reach = torch.tensor([0, *[AROUND_CELLS] * 3], device=cells.device)
    around = ((cells >= low - reach) & (cells <= high + reach)).all(dim=1) & ~own

    def change(chosen: Bool[Tensor, " cells"]) -> Float[Tensor, "3"]:
        px, lacks = pixels[chosen].sum(dim=0), error[chosen].sum(dim=0)
        high_rgb, low_rgb = (
            lacks[level].sum(dim=0) / px[level].sum().clamp(min=LEAST_PX)
            for level in (is_high, ~is_high & (pixels[own].sum(dim=0) >= LEAST_PX))
        )
        return high_rgb - low_rgb

    of_lamp = change(own)
    return bool(change(around) @ of_lamp < MOST_AROUND * (of_lamp @ of_lamp))


def _neighbours(cells: Int[Tensor, "cells 4"]) -> list[int]:
    """A number for each cell, the same for those of a body that touch, if only at a corner."""
    numbers = {tuple(cell): -1 for cell in cells.tolist()}
    steps = list(product((-1, 0, 1), repeat=3))
    count = 0
    for cell in numbers:
        waiting = [cell] if numbers[cell] < 0 else []
        count += len(waiting)
        while waiting:
            body, *place = waiting.pop()
            numbers[body, *place] = count - 1
            beside = ((body, *(a + b for a, b in zip(place, step, strict=True))) for step in steps)
            waiting += [one for one in beside if numbers.get(one, 0) < 0]
    return list(numbers.values())


def _boxes(cells: Int[Tensor, "cells 4"]) -> Blinking:
    """Boxes around cells of a body that touch, half a cell wider; those that overlap are one."""
    groups = torch.tensor(_neighbours(cells), device=cells.device)
    boxes = [
        (int(of_lamp[0, 0]), of_lamp[:, 1:].amin(dim=0) - 0.5, of_lamp[:, 1:].amax(dim=0) + 1.5)
        for group in range(int(groups.max()) + 1)
        for of_lamp in [cells[groups == group].cpu()]
    ]
    apart: list[_Box] = []
    while boxes:
        body, low, high = boxes.pop()
        beside = [box for box in apart if _overlap(box, (body, low, high))]
        apart = [box for box in apart if not any(box is one for one in beside)]
        if beside:  # what they make together may overlap with more
            lows, highs = zip(*(box[1:] for box in beside), strict=True)
            low, high = torch.stack([low, *lows]).amin(dim=0), torch.stack([high, *highs]).amax(0)
            boxes.append((body, low, high))
        else:
            apart.append((body, low, high))
    most = MOST_SIDE_M / CELL_M + 1
    small = [box for box in apart if float((box[2] - box[1]).max()) <= most]
    if not small:
        return Blinking.none()
    bodies, lows, highs = zip(*small, strict=True)
    low_m, high_m = CELL_M * torch.stack(lows), CELL_M * torch.stack(highs)
    lamps = Blinking.dark(torch.tensor(bodies), (low_m + high_m) / 2, high_m - low_m)
    return lamps.to(cells.device)


def _overlap(one: _Box, other: _Box) -> bool:
    return one[0] == other[0] and bool(((one[1] < other[2]) & (other[1] < one[2])).all())
