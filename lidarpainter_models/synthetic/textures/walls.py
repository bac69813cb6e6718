"""A facade as an image in metres, and what walls are made of.

x runs to the right as seen from the street, z up from the ground. Colours are sRGB 0..255; the
second plane is gloss.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from lidarpainter_models.synthetic.textures.lettering import draw_text
from lidarpainter_models.synthetic.textures.noise import as_rgba, fractal_noise, grain, value_noise

Colour = tuple[float, float, float]
WallKind = Literal["brick", "stucco", "boards", "panels"]
WALL_KINDS: tuple[WallKind, ...] = ("brick", "stucco", "boards", "panels")

BRICK_COLOURS: tuple[Colour, ...] = (
    (142, 74, 58), (122, 62, 50), (158, 98, 72), (112, 84, 70), (168, 140, 112), (96, 58, 52),
)  # fmt: skip
STUCCO_COLOURS: tuple[Colour, ...] = (
    (206, 196, 174), (188, 176, 150), (214, 208, 198), (168, 178, 172), (196, 160, 128),
    (150, 164, 178), (222, 214, 180), (176, 150, 146), (140, 148, 138), (202, 182, 186),
)  # fmt: skip


@dataclass(eq=False)
class WallCanvas:
    """A facade being drawn."""

    width_m: float
    height_m: float
    per_m: float
    colour: np.ndarray
    gloss: np.ndarray

    @classmethod
    def blank(cls, width_m: float, height_m: float, per_m: float) -> "WallCanvas":
        """Black and dull."""
        shape = max(round(height_m * per_m), 2), max(round(width_m * per_m), 2)
        return cls(
            width_m, height_m, per_m, np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
        )

    def window(self, rect: tuple[float, float, float, float]) -> tuple[slice, slice]:
        """Rows and columns of (x from, x to, z from, z to)."""
        x0, x1, z0, z1 = rect
        rows, columns = self.gloss.shape
        top, bottom = ((self.height_m - z) * self.per_m for z in (z1, z0))
        return (
            _within(round(top), round(bottom), rows),
            _within(round(x0 * self.per_m), round(x1 * self.per_m), columns),
        )

    def fill(
        self,
        rect: tuple[float, float, float, float],
        colour: Colour | np.ndarray,
        *,
        gloss: float = 0.0,
        strength: float = 1.0,
    ) -> None:
        """Lay a colour over a rectangle."""
        place = self.window(rect)
        area = self.colour[place]
        area += strength * (np.asarray(colour, np.float32) - area)
        self.gloss[place] += strength * (gloss - self.gloss[place])

    def text(self, rect: tuple[float, float, float, float], words: str, colour: Colour) -> None:
        """Fit words into a rectangle."""
        rows, columns = self.window(rect)
        box = (columns.start, rows.start, columns.stop, rows.stop)
        draw_text(self.colour, words, box=box, colour=colour)

    def rgba(self) -> np.ndarray:
        """Give the wall as a texture; the fourth channel is gloss."""
        return as_rgba(self.colour, self.gloss)


def _within(first: int, last: int, size: int) -> slice:
    """Select at least one line from `first` on, cut to the image."""
    return slice(min(max(first, 0), size), min(max(last, first + 1, 0), size))


def draw_wall(canvas: WallCanvas, kind: WallKind, colour: Colour, rng: np.random.Generator) -> None:
    """Cover the canvas with a material, weathered."""
    rows, columns = canvas.gloss.shape
    x = (np.arange(columns) + 0.5) / canvas.per_m
    z = canvas.height_m - (np.arange(rows) + 0.5) / canvas.per_m
    draw = {"brick": _brick, "stucco": _stucco, "boards": _boards, "panels": _panels}[kind]
    canvas.colour[:] = draw(x, z, colour, rng)
    cells = max(int(canvas.height_m / 3), 1), max(int(canvas.width_m / 3), 1)
    blotch = fractal_noise(rng, (rows, columns), cells, octaves=5, persistence=0.6) - 0.5
    streaks = value_noise(rng, (rows, columns), (2, max(int(canvas.width_m * 2.2), 1))) - 0.5
    foot = np.exp(-z / 0.5)[:, None]
    shade = 1 + 0.20 * blotch + 0.10 * streaks - 0.22 * foot + 0.012 * grain(rng, (rows, columns))
    canvas.colour *= shade[..., None]


def _brick(x: np.ndarray, z: np.ndarray, colour: Colour, rng: np.random.Generator) -> np.ndarray:
    """Courses of brick, each of its own shade, in pale mortar."""
    course = np.floor(z / 0.075).astype(int) + 2
    shifted = x[None, :] + 0.11 * (course % 2)[:, None]
    brick = np.floor(shifted / 0.22).astype(int)
    tones = rng.normal(1.0, 0.10, (course.max() + 1, brick.max() + 1))
    tone = tones[course[:, None], brick]
    is_joint = (shifted / 0.22 - brick < 0.07) | ((z / 0.075) % 1 < 0.2)[:, None]
    mortar = np.array([172, 164, 152.0]) * 0.82
    return np.where(is_joint[..., None], mortar, tone[..., None] * np.array(colour)).astype(
        np.float32
    )


def _stucco(x: np.ndarray, z: np.ndarray, colour: Colour, rng: np.random.Generator) -> np.ndarray:
    """Plain render with a soft grain and a few patched cracks."""
    tone = 1 + 0.015 * grain(rng, (z.size, x.size))
    image = (tone[..., None] * np.array(colour)).astype(np.float32)
    for _ in range(int(x.size * z.size / 60_000)):
        start = np.array([rng.integers(x.size), rng.integers(z.size)], float)
        walk = start + rng.normal([0, 6], [4, 5], (14, 2)).cumsum(0)
        shade = tuple(float(c) * 0.72 for c in colour)
        cv2.polylines(image, [walk.astype(np.int32)], False, shade, 1, cv2.LINE_AA)
    return image


def _boards(x: np.ndarray, z: np.ndarray, colour: Colour, rng: np.random.Generator) -> np.ndarray:
    """Painted horizontal boards, each with a shadow line below it."""
    board = z / 0.16
    tones = rng.normal(1.0, 0.03, int(board.max()) + 1)[board.astype(int)]
    tones = tones * np.where(board % 1 < 0.2, 0.74, 1.0) * (0.97 + 0.06 * (board % 1))
    return (tones[:, None, None] * np.array(colour) * np.ones((1, x.size, 1))).astype(np.float32)


def _panels(x: np.ndarray, z: np.ndarray, colour: Colour, rng: np.random.Generator) -> np.ndarray:
    """Concrete panels with open joints and bolt holes."""
    across, down = x / 1.8, z / 1.2
    column, row = across.astype(int), down.astype(int)
    tones = rng.normal(1.0, 0.045, (row.max() + 1, column.max() + 1))[row[:, None], column]
    is_joint = ((down % 1) < 0.02)[:, None] | ((across % 1) < 0.014)[None, :]
    corner_x = np.minimum(across % 1, 1 - across % 1) * 1.8
    corner_z = np.minimum(down % 1, 1 - down % 1) * 1.2
    is_hole = np.hypot(corner_z[:, None] - 0.2, corner_x[None, :] - 0.25) < 0.03
    tone = np.where(is_joint | is_hole, 0.5, tones)
    return (tone[..., None] * np.array(colour)).astype(np.float32)


def wall_tile(
    kind: WallKind, colour: Colour, rng: np.random.Generator, *, size_m: float, per_m: float
) -> np.ndarray:
    """A square of wall without openings, for sides and backs."""
    canvas = WallCanvas.blank(size_m, size_m, per_m)
    draw_wall(canvas, kind, colour, rng)
    return canvas.rgba()
