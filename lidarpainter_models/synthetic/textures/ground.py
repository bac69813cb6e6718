"""Road, sidewalk and lot textures: patched, cracked, painted, worn.

A road image covers a stretch of street coordinates: columns run along s, rows from the left
kerb to the right one. Its fourth channel is the share of paint.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from lidarpainter_models.synthetic.plan.layout import LANE_M, PARKING_M, StreetPlan
from lidarpainter_models.synthetic.textures.lettering import text_mask
from lidarpainter_models.synthetic.textures.noise import (
    as_rgba,
    coarse_noise,
    fractal_noise,
    grain,
    value_noise,
)

SUBPIXEL_BITS = 6
WHITE = (214.0, 212.0, 204.0)
YELLOW = (218.0, 172.0, 62.0)
GREEN = (84.0, 122.0, 92.0)


@dataclass(eq=False)
class GroundCanvas:
    """An image of the road addressed in metres."""

    start_m: float
    left_m: float
    per_m: float
    colour: np.ndarray
    """float32 (rows, columns, 3), sRGB 0..255."""
    paint: np.ndarray
    """float32 (rows, columns), share of paint."""

    @classmethod
    def blank(
        cls, start_m: float, end_m: float, left_m: float, right_m: float, per_m: float
    ) -> "GroundCanvas":
        """Black ground from `start_m` to `end_m`, `right_m` to `left_m`."""
        shape = round((left_m - right_m) * per_m), round((end_m - start_m) * per_m)
        return cls(
            start_m, left_m, per_m, np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
        )

    def pixels(self, places: np.ndarray) -> np.ndarray:
        """Fixed-point pixels for OpenCV of (s, d) rows."""
        places = np.asarray(places, float)
        pixels = np.stack([places[:, 0] - self.start_m, self.left_m - places[:, 1]], axis=1)
        pixels = (pixels * self.per_m - 0.5) * (1 << SUBPIXEL_BITS)
        return np.rint(pixels).astype(np.int32)

    def window(self, places: np.ndarray, margin_m: float) -> tuple[slice, slice]:
        """Rows and columns around places."""
        low = self.pixels(places).min(0) / (1 << SUBPIXEL_BITS) - margin_m * self.per_m
        high = self.pixels(places).max(0) / (1 << SUBPIXEL_BITS) + margin_m * self.per_m
        rows, columns = self.paint.shape
        return (
            slice(int(np.clip(low[1], 0, rows)), int(np.clip(high[1] + 2, 0, rows))),
            slice(int(np.clip(low[0], 0, columns)), int(np.clip(high[0] + 2, 0, columns))),
        )

    def fill(
        self,
        places: np.ndarray,
        colour: tuple[float, float, float],
        *,
        strength: float = 1.0,
        is_paint: bool = False,
        wear: np.ndarray | None = None,
    ) -> None:
        """Lay a colour over a polygon; `wear` (same shape as the canvas) thins it."""
        area = self.window(places, 0.2)
        mask, polygon = self._mask(area, places)
        if not mask.size:
            return
        cv2.fillPoly(mask, [polygon], 255, cv2.LINE_AA, SUBPIXEL_BITS)
        share = mask.astype(np.float32) * (strength / 255)
        if wear is not None:
            share *= wear[area]
        self._mix(area, share, colour, is_paint=is_paint)

    def stroke(
        self,
        places: np.ndarray,
        width_m: float,
        colour: tuple[float, float, float],
        *,
        strength: float = 1.0,
    ) -> None:
        """Lay a colour along a polyline."""
        area = self.window(places, width_m + 0.1)
        mask, line = self._mask(area, places)
        if not mask.size:
            return
        width_px = width_m * self.per_m
        thickness = max(round(width_px), 1)
        cv2.polylines(mask, [line], False, 255, thickness, cv2.LINE_AA, SUBPIXEL_BITS)
        share = mask.astype(np.float32) * (strength * min(width_px, 1.0) / 255)
        self._mix(area, share, colour, is_paint=False)

    def _mask(self, area: tuple[slice, slice], places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """An empty mask of an area, and the pixels of places in it."""
        shift = np.array([area[1].start, area[0].start], np.int32) << SUBPIXEL_BITS
        return np.zeros(self.paint[area].shape, np.uint8), self.pixels(places) - shift

    def _mix(
        self,
        place: tuple[slice, slice],
        share: np.ndarray,
        colour: tuple[float, float, float],
        *,
        is_paint: bool,
    ) -> None:
        area, paint = self.colour[place], self.paint[place]
        area += share[..., None] * (np.asarray(colour, np.float32) - area)
        paint += share * (float(is_paint) - paint)


def strip(s_from: float, s_to: float, d_middle: float, width: float) -> np.ndarray:
    """Corners of a rectangle in street coordinates."""
    low, high = d_middle - width / 2, d_middle + width / 2
    return np.array([[s_from, low], [s_to, low], [s_to, high], [s_from, high]])


def asphalt_detail(rng: np.random.Generator) -> np.ndarray:
    """Stones of asphalt as a repeating texture; only its fourth channel is used."""
    size = 512
    fine = grain(rng, (size, size))
    border = 8  # wide enough for the blur to meet the other side of the texture
    wrapped = np.pad(grain(rng, (size, size)), border, mode="wrap")
    coarse = cv2.GaussianBlur(wrapped, (0, 0), 1.6)[border:-border, border:-border]
    blotch = fractal_noise(rng, (size, size), (8, 8), octaves=4) - 0.5
    value = 0.5 + 0.13 * fine + 0.45 * coarse + 0.5 * blotch
    return as_rgba(np.full((size, size, 3), 255.0), value)


def lay_asphalt(canvas: GroundCanvas, rng: np.random.Generator, plan: StreetPlan) -> None:
    """Grey of changing age, darker wheel tracks and an oil stain along the middle of the lanes."""
    rows, columns = canvas.paint.shape
    length_m, width_m = columns / canvas.per_m, rows / canvas.per_m
    cells = max(int(width_m / 4), 1), max(int(length_m / 7), 1)
    tone = 98 + 62 * (coarse_noise(rng, (rows, columns), cells, persistence=0.6) - 0.5)
    d = (canvas.left_m - (np.arange(rows) + 0.5) / canvas.per_m).astype(np.float32)
    lanes = (0.0, LANE_M, *plan.oncoming_d_m)
    for lane in lanes:
        tracks = np.exp(-(((np.abs(d - lane) - 0.8) / 0.33) ** 2))
        oil = np.exp(-(((d - lane) / 0.28) ** 2))
        streak = value_noise(rng, (1, columns), (1, max(int(length_m / 9), 1)))
        tone += 6 * tracks[:, None] - 11 * oil[:, None] * (0.4 + 0.9 * streak)
    gutter = np.exp(-(d - plan.right_kerb_m) / 0.35) + np.exp((d - plan.left_kerb_m) / 0.35)
    tone -= 22 * gutter[:, None]
    tone += 2.2 * grain(rng, (rows, columns))
    for channel, share in enumerate((1.0, 0.985, 0.965)):
        canvas.colour[..., channel] = share * tone


def lay_repairs(canvas: GroundCanvas, rng: np.random.Generator, plan: StreetPlan) -> None:
    """Patches with sealed edges, utility cuts, tar lines and cracks."""
    end_m = canvas.start_m + canvas.paint.shape[1] / canvas.per_m
    length = end_m - canvas.start_m
    lanes = (0.0, LANE_M, *plan.oncoming_d_m, plan.parking_d_m[0], plan.parking_d_m[1])
    for _ in range(int(length / 14)):  # lanes resurfaced for a while
        s, d = rng.uniform(canvas.start_m - 10, end_m), lanes[int(rng.integers(len(lanes)))]
        part = strip(s, s + rng.uniform(8, 30), d + rng.normal(0, 0.3), rng.uniform(1.4, 3.6))
        grey = rng.choice([rng.uniform(52, 76), rng.uniform(112, 140)])
        part = part + rng.uniform(-0.15, 0.15, (4, 2))
        canvas.fill(part, (grey, grey * 0.985, grey * 0.965), strength=rng.uniform(0.45, 0.85))
    for _ in range(int(length / 5)):
        s, d = rng.uniform(canvas.start_m, end_m), rng.uniform(plan.right_kerb_m, plan.left_kerb_m)
        size = (rng.uniform(1, 9), rng.uniform(0.6, 2.6))
        grey = rng.choice([rng.uniform(48, 74), rng.uniform(108, 136)])
        patch = strip(s, s + size[0], d, size[1]) + rng.uniform(-0.12, 0.12, (4, 2))
        canvas.fill(patch, (grey, grey * 0.985, grey * 0.97), strength=rng.uniform(0.5, 0.95))
        canvas.stroke(np.vstack([patch, patch[:1]]), 0.035, (46, 45, 45), strength=0.7)
    for _ in range(int(length / 1.1)):
        start = np.array(
            [rng.uniform(canvas.start_m, end_m), rng.uniform(plan.right_kerb_m, plan.left_kerb_m)]
        )
        angle = rng.choice([0.0, np.pi / 2, rng.uniform(0, np.pi)])
        steps = rng.normal(0, 0.55, int(rng.integers(8, 50))).cumsum() * 0.45 + angle
        walk = start + np.stack([np.cos(steps), np.sin(steps)], 1).cumsum(0) * 0.17
        is_tar = rng.random() < 0.2
        shade = (40, 40, 41) if is_tar else (52, 50, 48)
        canvas.stroke(walk, 0.05 if is_tar else 0.014, shade, strength=0.85)


def lay_ironwork(canvas: GroundCanvas, rng: np.random.Generator, plan: StreetPlan) -> None:
    """Manholes, valve covers and drains."""
    end_m = canvas.start_m + canvas.paint.shape[1] / canvas.per_m
    angles = np.linspace(0, 2 * np.pi, 28, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for s in np.arange(canvas.start_m + 3, end_m, 9.0):
        centre = np.array([s + rng.uniform(-3, 3), rng.choice([0.4, -0.6, 3.1, 4.0, 7.5])])
        radius = 0.36 if rng.random() < 0.6 else 0.16
        canvas.fill(centre + circle * (radius + 0.1), (72, 71, 70), strength=0.8)
        canvas.fill(centre + circle * radius, (66, 60, 55))
        canvas.stroke(centre + circle * radius * 0.86, 0.025, (98, 92, 86))
        for offset in np.linspace(-0.6, 0.6, 5) * radius:
            bar = centre + np.array([[-0.62 * radius, offset], [0.62 * radius, offset]])
            canvas.stroke(bar, 0.022, (96, 90, 84))
    for s in np.arange(canvas.start_m + 11, end_m, 24.0):
        for d in (plan.right_kerb_m + 0.3, plan.left_kerb_m - 0.3):
            canvas.fill(strip(s, s + 0.9, d, 0.42), (46, 45, 45))
            for bar in np.linspace(s + 0.08, s + 0.82, 8):
                canvas.fill(strip(bar, bar + 0.05, d, 0.36), (14, 14, 15))


def sidewalk_slabs(rng: np.random.Generator, per_m: float) -> np.ndarray:
    """Concrete slabs of 1.5 m, stained and chipped, as a repeating 12 m x 6 m texture."""
    rows, columns = round(6 * per_m), round(12 * per_m)
    tone = 158 + 26 * (fractal_noise(rng, (rows, columns), (4, 8), octaves=5) - 0.5)
    tone = tone + 2.5 * grain(rng, (rows, columns))
    slab = round(1.5 * per_m)
    shades = np.kron(rng.normal(0, 6, (4, 8)), np.ones((slab, slab)))[:rows, :columns]
    tone = tone + shades
    for _ in range(60):  # gum and stains
        centre = int(rng.integers(columns)), int(rng.integers(rows))
        radius = int(rng.uniform(0.01, 0.035) * per_m) + 1
        cv2.circle(tone, centre, radius, float(rng.uniform(85, 125)), -1, cv2.LINE_AA)
    joint = max(round(0.015 * per_m), 1)
    for start in range(0, columns, slab):
        tone[:, start : start + joint] -= 58
    for start in range(0, rows, slab):
        tone[start : start + joint] -= 58
    return as_rgba(tone[..., None] * np.array([1.0, 0.985, 0.95]))


def lot_ground(rng: np.random.Generator) -> np.ndarray:
    """Worn concrete between buildings, repeating every 16 m."""
    tone = 122 + 46 * (fractal_noise(rng, (512, 512), (4, 4), octaves=6, persistence=0.6) - 0.5)
    tone = tone + 3 * grain(rng, (512, 512))
    for edge in (0, 256):
        tone[edge : edge + 2] -= 35
        tone[:, edge : edge + 2] -= 35
    return as_rgba(tone[..., None] * np.array([1.0, 0.97, 0.92]))


def stencil(
    canvas: GroundCanvas, text: str, place: tuple[float, float], size_m: tuple[float, float]
) -> None:
    """White letters on the road, readable for who drives along +s (tops point ahead).

    The place is (s, d) of the middle, the size is length along s and width across.
    """
    height, width = round(size_m[0] * canvas.per_m), round(size_m[1] * canvas.per_m)
    mask = text_mask(text, width_px=width, height_px=height, weight=0.17)
    filled = np.flatnonzero(mask.any(1))
    if filled.size:  # road letters are stretched along the road
        tight = mask[filled[0] : filled[-1] + 1]
        mask = cv2.resize(tight, (width, height), interpolation=cv2.INTER_LINEAR)
    mask = np.rot90(mask, -1)  # the text's top now looks along +s, its left to +d
    row = round((canvas.left_m - place[1]) * canvas.per_m) - mask.shape[0] // 2
    column = round((place[0] - canvas.start_m) * canvas.per_m) - mask.shape[1] // 2
    if row < 0 or column < 0 or column + mask.shape[1] > canvas.paint.shape[1]:
        return
    area = slice(row, row + mask.shape[0]), slice(column, column + mask.shape[1])
    canvas._mix(area, mask * 0.85, WHITE, is_paint=True)


def parking_edge(plan: StreetPlan) -> tuple[float, float]:
    """Where (d) the lines between traffic and parked cars run, right and left."""
    return plan.right_kerb_m + PARKING_M, plan.left_kerb_m - PARKING_M
