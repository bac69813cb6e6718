"""Side, front, rear and top views of a car drawn into one texture.

Views in the atlas, top to bottom: left side (nose to the left), front, rear beside it, top. Sides
share one view. The fourth channel is gloss.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from lidarpainter_models.synthetic.plan.car_kinds import CarShape
from lidarpainter_models.synthetic.raytracing.scene_arrays import KIND_CUT_OUT
from lidarpainter_models.synthetic.textures.noise import as_rgba, fractal_noise
from lidarpainter_models.synthetic.textures.signs import licence_plate
from lidarpainter_models.synthetic.textures.surfaces import StreetClass, Surface, SurfaceSet

PER_M = 96.0
PAINTS = (
    (206, 208, 210), (40, 42, 46), (122, 126, 132), (164, 166, 170), (138, 26, 28), (30, 48, 90),
    (60, 66, 72), (96, 34, 38), (52, 74, 64), (172, 160, 132), (22, 22, 24), (176, 92, 40),
    (62, 98, 132), (212, 212, 206), (92, 82, 74), (28, 29, 32), (146, 148, 150), (80, 84, 90),
)  # fmt: skip
GLASS = (26.0, 31.0, 36.0)
PAINT_GLOSS, GLASS_GLOSS = 0.62, 1.0
Places = np.ndarray | list[tuple[float, float]]


@dataclass(frozen=True, eq=False)
class CarAtlas:
    """Surfaces of one car and where its views lie."""

    body: int
    paint: int
    rubber: int
    chrome: int
    rim: int
    plate: int
    layout: "_Layout"

    def uv(self, corners: np.ndarray) -> np.ndarray:
        """Texture places (faces, 3, 2) of corners (faces, 3, 3), by the way each face looks."""
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal = np.abs(normal) / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        is_end = (normal[:, 0] > 0.62) & (normal[:, 0] > normal[:, 2])
        is_top = ~is_end & (normal[:, 2] > normal[:, 1])
        layout = self.layout
        x, y, z = corners[..., 0], corners[..., 1], corners[..., 2]
        is_rear = corners[:, :, 0].mean(1) < 0
        end = np.where(is_rear[:, None, None], layout.rear(y, z), layout.front(y, z))
        return np.where(
            is_end[:, None, None],
            end,
            np.where(is_top[:, None, None], layout.top(x, y), layout.side(x, z)),
        )


@dataclass(frozen=True)
class _Layout:
    """Where the views lie in the atlas, as fractions."""

    length_m: float
    width_m: float
    height_m: float

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the whole atlas."""
        return max(self.length_m, 2 * self.width_m), 2 * self.height_m + self.width_m

    def _place(self, across: np.ndarray, down: np.ndarray) -> np.ndarray:
        width, height = self.size_m
        return np.stack([across / width, down / height], axis=-1)

    def side(self, x: np.ndarray, z: np.ndarray) -> np.ndarray:
        return self._place(self.length_m / 2 - x, self.height_m - z)

    def front(self, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        return self._place(y + self.width_m / 2, 2 * self.height_m - z)

    def rear(self, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        return self._place(1.5 * self.width_m - y, 2 * self.height_m - z)

    def top(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self._place(self.length_m / 2 - x, 2 * self.height_m + self.width_m / 2 - y)


def add_car_surfaces(surfaces: SurfaceSet, shape: CarShape, rng: np.random.Generator) -> CarAtlas:
    """Paint a car: a random colour, plates of its own."""
    paint = PAINTS[int(rng.integers(len(PAINTS)))]
    painter = _CarPainter(shape, paint, rng)
    texture = surfaces.add_texture(painter.draw())
    car = StreetClass.CAR
    plate = surfaces.add_texture(licence_plate(rng))
    rim = surfaces.add_texture(_draw_rim(rng))
    return CarAtlas(
        body=surfaces.add(Surface(semantics=car, texture=texture, gloss=1.0)),
        paint=surfaces.plain(paint, car, gloss=PAINT_GLOSS),
        rubber=surfaces.add(Surface(semantics=car, tint=(0.012, 0.012, 0.013))),
        chrome=surfaces.add(Surface(semantics=car, tint=(0.35, 0.36, 0.37), gloss=0.8)),
        rim=surfaces.add(Surface(semantics=car, texture=rim, kind=KIND_CUT_OUT)),
        plate=surfaces.add(Surface(semantics=car, texture=plate)),
        layout=painter.layout,
    )


class _CarPainter:
    """Draws the four views in metres."""

    def __init__(
        self, shape: CarShape, paint: tuple[int, int, int], rng: np.random.Generator
    ) -> None:
        self.shape, self.rng = shape, rng
        self.paint = np.array(paint, float)
        self.layout = _Layout(shape.length_m, shape.width_m, shape.height_m)
        width, height = self.layout.size_m
        self.rows, self.columns = round(height * PER_M), round(width * PER_M)
        dirt = fractal_noise(rng, (self.rows, self.columns), (6, 9), octaves=4)
        self.colour = ((0.97 + 0.06 * dirt)[..., None] * self.paint).astype(np.float32)
        self.gloss = np.full((self.rows, self.columns), PAINT_GLOSS, np.float32)

    def draw(self) -> np.ndarray:
        """The atlas as RGBA bytes."""
        self._draw_side()
        self._draw_ends()
        self._draw_top()
        return as_rgba(self.colour, self.gloss)

    def _pixels(self, view: str, places: Places) -> np.ndarray:
        """Fixed-point pixels for OpenCV of places in a view's two metres."""
        uv = getattr(self.layout, view)(*np.asarray(places, float).T)
        return np.rint((uv * [self.columns, self.rows] - 0.5) * 16).astype(np.int32)

    def _fill(self, view: str, places: Places, colour: tuple, gloss: float) -> None:
        """Fill a polygon of a view, given in the view's two metres."""
        pixels = self._pixels(view, places)
        cv2.fillPoly(self.colour, [pixels], tuple(map(float, colour)), cv2.LINE_AA, 4)
        cv2.fillPoly(self.gloss, [pixels], gloss, cv2.LINE_8, 4)

    def _rect(self, view: str, rect: tuple, colour: tuple, gloss: float = 0.3) -> None:
        a0, a1, b0, b1 = rect
        self._fill(view, [(a0, b0), (a1, b0), (a1, b1), (a0, b1)], colour, gloss)

    def _line(self, places: list[tuple[float, float]]) -> None:
        """A seam on the side."""
        pixels = self._pixels("side", places)
        shade = tuple(float(c) for c in self.paint * 0.35)
        cv2.polylines(self.colour, [pixels], False, shade, 1, cv2.LINE_AA, 4)

    def _roof(self, x: float) -> float:
        return float(np.interp(x, *np.transpose(self.shape.roof)))

    def _belt(self, x: float) -> float:
        return float(np.interp(x, *np.transpose(self.shape.belt)))

    def _draw_side(self) -> None:
        shape = self.shape
        half = shape.length_m / 2
        self._rect("side", (-half, half, 0.0, 0.33), (30, 30, 31), 0.1)
        rear_base, _, _, front_base = shape.glass
        edges = [rear_base + 0.1, *shape.pillars, front_base - 0.1]
        is_van = shape.category == "van"
        for index, (start, end) in enumerate(pairwise(edges)):
            if is_van and index == 0:
                continue  # the load bay has no windows
            xs = np.linspace(start + 0.04, end - 0.04, 12)
            low = [(x, self._belt(x) + 0.04) for x in xs]
            high = [(x, max(self._roof(x) - 0.13, self._belt(x) + 0.05)) for x in xs[::-1]]
            self._fill("side", low + high, GLASS, GLASS_GLOSS)
            self._draw_inside(start, end)
            self._line([(start, self._belt(start)), (start + 0.02, 0.36)])
        self._line([(edges[-1] - 0.05, self._belt(edges[-1])), (edges[-1] - 0.02, 0.36)])
        self._line([(edges[0] + 0.3, 0.36), (edges[-1], 0.36)])
        self._line([(-half, self._belt(0) - 0.22), (half - 0.3, self._belt(0) - 0.26)])
        for x in shape.wheel_x_m:
            angles = np.linspace(0, 2 * np.pi, 40)
            radius = shape.wheel_radius_m + 0.06
            arch = np.stack([x + radius * np.cos(angles), radius * (1 + np.sin(angles))], 1)
            self._fill("side", arch, (12, 12, 13), 0.0)
        nose = self._belt(half - 0.2)
        self._rect("side", (half - 0.42, half, nose - 0.16, nose + 0.02), (226, 230, 232), 1.0)
        tail = self._belt(-half + 0.1)
        self._rect("side", (-half, -half + 0.3, tail - 0.2, tail + 0.02), (168, 18, 20), 0.9)

    def _draw_inside(self, start: float, end: float) -> None:
        """What is seen through a side window: the light of the other side, and a seat."""
        if end - start < 0.5:
            return
        xs = np.linspace(start + 0.12, end - 0.12, 8)
        low = [(x, self._belt(x) + 0.14) for x in xs]
        high = [(x, max(self._roof(x) - 0.19, self._belt(x) + 0.15)) for x in xs[::-1]]
        self._fill("side", low + high, (66, 74, 80), GLASS_GLOSS)
        seat, belt = start + 0.45 * (end - start), self._belt(start)
        angles = np.linspace(0, 2 * np.pi, 16)
        head = np.stack([seat + 0.1 * np.cos(angles), belt + 0.2 + 0.12 * np.sin(angles)], 1)
        self._fill("side", head, (20, 21, 23), GLASS_GLOSS)
        self._rect("side", (seat - 0.19, seat + 0.12, belt + 0.04, belt + 0.14), (20, 21, 23), 1.0)

    def _draw_ends(self) -> None:
        shape = self.shape
        half, belt_front = shape.width_m / 2, self._belt(shape.length_m / 2 - 0.15)
        dark = (22, 22, 24)
        shade = np.linspace(0.72, 1.0, max(round(0.4 * PER_M), 2))[::-1]  # less light from below
        for foot in (self.shape.height_m, 2 * self.shape.height_m):
            line = round((foot - 0.62) * PER_M)
            area = self.colour[line : line + len(shade)]
            area *= shade[: len(area), None, None]
        self._rect("front", (-half, half, 0.2, 0.34), (34, 34, 35), 0.1)
        self._rect("front", (-0.5, 0.5, 0.36, 0.56), dark, 0.3)
        for bar in np.linspace(0.38, 0.54, 4):
            self._rect("front", (-0.5, 0.5, bar, bar + 0.012), (120, 122, 126), 0.6)
        for side in (-1, 1):
            lamp = (side * (half - 0.08), side * (half - 0.46), belt_front - 0.13, belt_front)
            self._rect("front", lamp, (232, 236, 238), 1.0)
        rear_belt = self._belt(-shape.length_m / 2 + 0.15)
        self._rect("rear", (-half, half, 0.2, 0.4), (34, 34, 35), 0.1)
        seam = tuple(self.paint * 0.4)
        self._rect("rear", (-half, half, 0.5, 0.512), seam, 0.2)
        self._rect("rear", (-half + 0.22, half - 0.22, rear_belt + 0.03, rear_belt + 0.042), seam)
        for side in (-1, 1):
            self._rect("rear", (side * 0.5, side * 0.62, 0.26, 0.32), (120, 120, 122), 0.6)
            lamp = (side * (half - 0.12), side * (half - 0.3), 0.43, 0.47)
            self._rect("rear", lamp, (150, 30, 28), 0.6)
        self._rect("rear", (-0.07, 0.07, rear_belt - 0.12, rear_belt - 0.04), (170, 172, 176), 0.8)
        self._rect("rear", (-0.3, 0.3, 0.54, 0.72), tuple(self.paint * 0.6), 0.3)
        for side in (-1, 1):
            lamp = (side * (half - 0.02), side * (half - 0.36), rear_belt - 0.22, rear_belt + 0.02)
            self._rect("rear", lamp, (172, 16, 20), 0.9)
            inner = (side * (half - 0.2), side * (half - 0.34), rear_belt - 0.2, rear_belt - 0.13)
            self._rect("rear", inner, (226, 206, 190), 0.9)
        if self._roof(shape.glass[1]) > rear_belt + 0.3:
            top = self._roof(shape.glass[1]) - 0.1
            glass = [
                (-half + 0.2, rear_belt + 0.1), (half - 0.2, rear_belt + 0.1),
                (half - 0.32, top), (-half + 0.32, top),
            ]  # fmt: skip
            self._fill("rear", glass, GLASS, GLASS_GLOSS)

    def _draw_top(self) -> None:
        rear_base, rear_top, front_top, front_base = self.shape.glass
        half = self.shape.width_m / 2 * 0.93
        for base, top, inset in ((front_base, front_top, 0.06), (rear_base, rear_top, 0.08)):
            glass = [
                (base, -half + inset), (top, -half + 0.2), (top, half - 0.2), (base, half - inset),
            ]  # fmt: skip
            self._fill("top", glass, GLASS, GLASS_GLOSS)
        if self.shape.category == "pickup":
            tail = -self.shape.length_m / 2
            bed = (tail + 0.12, rear_base - 0.1, -half + 0.12, half - 0.12)
            self._rect("top", bed, (32, 32, 33), 0.05)


def _draw_rim(rng: np.random.Generator) -> np.ndarray:
    """A tyre with a spoked rim as a round cut-out."""
    size = 96
    centre = (size // 2, size // 2)
    image = np.full((size, size, 3), 16, np.float32)
    metal = tuple([float(rng.uniform(90, 190))] * 3)
    cv2.circle(image, centre, int(size * 0.34), (34, 34, 36), -1, cv2.LINE_AA)
    spokes = int(rng.choice([5, 6, 7, 10]))
    for spoke in range(spokes):
        angle = 2 * np.pi * spoke / spokes
        tip = centre[0] + 0.33 * size * np.cos(angle), centre[1] + 0.33 * size * np.sin(angle)
        end = int(tip[0]), int(tip[1])
        cv2.line(image, centre, end, metal, max(40 // spokes, 3), cv2.LINE_AA)
    cv2.circle(image, centre, int(size * 0.34), metal, 3, cv2.LINE_AA)
    cv2.circle(image, centre, int(size * 0.08), metal, -1, cv2.LINE_AA)
    mask = np.zeros((size, size), np.uint8)
    cv2.circle(mask, centre, size // 2 - 1, 255, -1, cv2.LINE_AA)
    return as_rgba(image, mask / 255)
