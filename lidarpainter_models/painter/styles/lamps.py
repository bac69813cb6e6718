"""Lamps found in a daylight image: what would shine at night.

Three kinds are looked for, each by its look in daylight and, where the camera is known, by its size
and its height above the ground:

* signal: small, strongly coloured and bright (tail lights, traffic lights);
* window: dark upright rectangles in facades, of which a share drawn at random is lit;
* street: the outer ends of upright thin structures, five to ten metres up, against the sky.

Without depth or ground only signals are found. A lamp is a patch of the image, so that light
comes from where something was seen; nothing is invented elsewhere.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from lidarpainter_models.weather.darkness import WARM_RGB
from lidarpainter_models.weather.light import luminance

LampKind = Literal["signal", "window", "street"]

SIGNAL_CHROMA = 0.45
"""Least excess of red over both other channels, as a share of it; of green over red two thirds."""
SIGNAL_LEAST = (0.25, 0.45)
"""Least red and green in display rgb."""
SIGNAL_SIZE_M = (0.05, 0.6)
SIGNAL_HEIGHT_M = (0.4, 8.0)
WINDOW_SIZE_M = (0.5, 3.0)
WINDOW_HEIGHT_M = (2.2, 40.0)
WINDOW_DARKNESS = 0.6
"""Luminance of a pane against its surroundings, at most."""
WINDOW_FILLING = 0.62
"""Least share of its bounding box that a window covers."""
STREET_WIDTH_M = 0.45
STREET_HEIGHT_M = (4.5, 11.0)
STREET_POLE_M = 2.0
"""A lamp hangs on something that is seen at least so high, and higher than wide."""
STREET_FARTHEST_M = 60.0
FARTHEST_M = 140.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Lamp:
    """A patch of the image that shines."""

    kind: LampKind
    top_px: int
    left_px: int
    patch: Bool[Tensor, "rows columns"]
    """Its pixels, from `top_px` and `left_px` on."""
    colour: Float[Tensor, "3"]
    """Linear rgb, brightest channel 1."""
    distance_m: float

    @property
    def window(self) -> tuple[slice, slice]:
        """Where the patch lies."""
        rows, columns = self.patch.shape
        return (slice(self.top_px, self.top_px + rows), slice(self.left_px, self.left_px + columns))


@dataclass(frozen=True, kw_only=True, eq=False)
class Place:
    """What lamps are looked for in."""

    light: Float[Tensor, "height width 3"]
    """The daylight image, linear."""
    display: Float[Tensor, "height width 3"]
    distance_m: Float[Tensor, "height width"]
    height_m: Float[Tensor, "height width"] | None
    """Above the ground; None where that is unknown."""
    surface: Bool[Tensor, "height width"]
    focal_px: float


def find_lamps(place: Place, *, lit_share: float, generator: Generator) -> list[Lamp]:
    """Every signal and street lamp, and a random share of the windows."""
    lamps = list(_signals(place))
    if place.height_m is not None:
        panes = list(_windows(place))
        drawn = torch.rand(len(panes), generator=generator) < lit_share
        lamps += [pane for pane, is_lit in zip(panes, drawn.tolist(), strict=True) if is_lit]
        lamps += _street_lamps(place)
    return lamps


def _signals(place: Place) -> Iterator[Lamp]:
    """Red ones and green ones."""
    red, green, blue = place.display.unbind(-1)
    is_red = (red - torch.maximum(green, blue) > SIGNAL_CHROMA * red) & (red > SIGNAL_LEAST[0])
    is_green = (green - red > SIGNAL_CHROMA / 1.5 * green) & (green >= blue)
    is_green &= green > SIGNAL_LEAST[1]
    for mask, rgb in ((is_red, (1.0, 0.05, 0.02)), (is_green, (0.1, 1.0, 0.45))):
        for lamp in _patches(place, mask & place.surface, "signal", rgb, SIGNAL_SIZE_M):
            if _is_within(place, lamp, SIGNAL_HEIGHT_M):
                yield lamp


def _windows(place: Place) -> Iterator[Lamp]:
    """Upright dark rectangles high enough to be on a facade."""
    grey = luminance(place.light).numpy()
    surface = place.surface.float().numpy()
    sigma_px = place.focal_px * 1.5 / 30.0  # a metre and a half, at thirty
    around = cv2.GaussianBlur(grey * surface, (0, 0), sigma_px)
    around /= np.maximum(cv2.GaussianBlur(surface, (0, 0), sigma_px), 1e-3)
    dark = torch.from_numpy(grey < WINDOW_DARKNESS * around) & place.surface
    for lamp in _patches(place, dark, "window", WARM_RGB, WINDOW_SIZE_M):
        rows, columns = lamp.patch.shape
        filling = float(lamp.patch.float().mean())
        is_upright = 0.3 * columns < rows < 4 * columns
        if is_upright and filling > WINDOW_FILLING and _is_within(place, lamp, WINDOW_HEIGHT_M):
            yield lamp


def _street_lamps(place: Place) -> Iterator[Lamp]:
    """The outermost end of thin structures before the sky, at the height of street lamps."""
    surface = place.surface.numpy().astype(np.uint8)
    side_px = max(3, round(STREET_WIDTH_M * place.focal_px / 15.0))  # as wide, at fifteen metres
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (side_px, side_px))
    solid = cv2.morphologyEx(surface, cv2.MORPH_OPEN, kernel)
    thin = (surface > 0) & (cv2.dilate(solid, kernel) == 0)  # ragged outlines are no poles
    for top, left, patch in _components(torch.from_numpy(thin)):
        rows, columns = patch.nonzero().unbind(-1)
        foot = columns[rows == rows.max()].float().mean()
        reach = (columns - foot).abs() - 2.0 * rows  # far out, and rather high than far
        end = int(reach.argmax())
        row, column = top + int(rows[end]), left + int(columns[end])
        side = max(2, round(0.3 * place.focal_px / float(place.distance_m[row, column])))
        first_row, first_column = max(0, row - side // 3), max(0, column - side // 2)
        window = slice(first_row, row + side // 3 + 1), slice(first_column, column + side // 2 + 1)
        head = torch.from_numpy(thin[window])
        lamp = _lamp(place, "street", first_row, first_column, head, WARM_RGB)
        if lamp is None or not _is_within(place, lamp, STREET_HEIGHT_M):
            continue
        pole_m = patch.shape[0] * lamp.distance_m / place.focal_px
        is_pole = pole_m > STREET_POLE_M and patch.shape[0] > patch.shape[1]
        if (
            is_pole
            and lamp.distance_m < STREET_FARTHEST_M
            and _is_free(place, row, column, 3 * side)
        ):
            yield lamp


def _is_free(place: Place, row: int, column: int, reach_px: int) -> bool:
    """Whether most of what is around a pixel is sky."""
    rows = slice(max(0, row - reach_px), row + reach_px + 1)
    columns = slice(max(0, column - reach_px), column + reach_px + 1)
    return float(place.surface[rows, columns].float().mean()) < 0.4


def _patches(
    place: Place,
    mask: Bool[Tensor, "height width"],
    kind: LampKind,
    rgb: tuple[float, float, float],
    size_m: tuple[float, float],
) -> Iterator[Lamp]:
    """Connected pieces of a mask that are as large as such a lamp."""
    for top, left, patch in _components(mask):
        lamp = _lamp(place, kind, top, left, patch, rgb)
        if lamp is None:
            continue
        side_m = max(patch.shape) * lamp.distance_m / place.focal_px
        if size_m[0] <= side_m <= size_m[1]:
            yield lamp


def _components(
    mask: Bool[Tensor, "height width"],
) -> Iterator[tuple[int, int, Bool[Tensor, "rows columns"]]]:
    """Top, left and pixels of every connected piece of more than two pixels."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.numpy().astype(np.uint8))
    for label in range(1, count):
        left, top, width, height, area = (int(value) for value in stats[label])
        if area > 2:
            piece = labels[top : top + height, left : left + width] == label
            yield top, left, torch.from_numpy(piece)


def _lamp(
    place: Place,
    kind: LampKind,
    top: int,
    left: int,
    patch: Bool[Tensor, "rows columns"],
    rgb: tuple[float, float, float],
) -> Lamp | None:
    """A lamp, unless it is too far to matter."""
    rows, columns = patch.shape
    window = slice(top, top + rows), slice(left, left + columns)
    if not bool(patch.any()):
        return None
    distance_m = float(place.distance_m[window][patch].median())
    if not distance_m < FARTHEST_M:
        return None
    return Lamp(
        kind=kind,
        top_px=top,
        left_px=left,
        patch=patch,
        colour=torch.tensor(rgb),
        distance_m=distance_m,
    )


def _is_within(place: Place, lamp: Lamp, height_m: tuple[float, float]) -> bool:
    """Whether a lamp hangs between two heights; True where the ground is unknown."""
    if place.height_m is None:
        return True
    height = float(place.height_m[lamp.window][lamp.patch].median())
    return height_m[0] <= height <= height_m[1]
