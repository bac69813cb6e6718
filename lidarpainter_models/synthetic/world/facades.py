"""Facades: where the openings of a building are, how it is drawn, and its relief as a mesh."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lidarpainter_models.synthetic.textures.openings import (
    FRAMES,
    Opening,
    draw_door,
    draw_gate,
    draw_glass,
    draw_shop_window,
    draw_window,
)
from lidarpainter_models.synthetic.textures.walls import (
    BRICK_COLOURS,
    STUCCO_COLOURS,
    WALL_KINDS,
    Colour,
    WallCanvas,
    WallKind,
    draw_wall,
)
from lidarpainter_models.synthetic.world.meshes import MeshBuilder

GroundFloor = Literal["shop", "gate", "homes"]
GROUND_FLOOR_M = 3.9
FLOOR_M = 3.3
EMPTY_M = 1e-3


@dataclass(frozen=True, kw_only=True)
class FacadeStyle:
    """What a building is like, on every side."""

    wall: WallKind
    colour: Colour
    frame: Colour
    trim: Colour
    ground_floor: GroundFloor
    window_width_m: float
    window_height_m: float
    spacing_m: float
    panes: tuple[int, int]
    is_glazed: bool
    """An office with a curtain of glass above the ground floor."""


def draw_style(rng: np.random.Generator) -> FacadeStyle:
    """A random building."""
    wall = WALL_KINDS[int(rng.integers(len(WALL_KINDS)))]
    colours = BRICK_COLOURS if wall == "brick" else STUCCO_COLOURS
    colour = _colour(np.array(colours[int(rng.integers(len(colours)))]) * 1.0)
    ground: tuple[GroundFloor, ...] = ("shop", "shop", "shop", "gate", "homes")
    is_industrial = wall in ("brick", "panels") and rng.random() < 0.5
    window_width_m = rng.uniform(1.9, 2.8) if is_industrial else rng.uniform(0.95, 1.5)
    return FacadeStyle(
        wall=wall,
        colour=colour,
        frame=FRAMES[int(rng.integers(len(FRAMES)))],
        trim=_colour(np.array([206, 200, 186]) * rng.uniform(0.35, 1.05)),
        ground_floor=ground[int(rng.integers(len(ground)))],
        window_width_m=window_width_m,
        window_height_m=rng.uniform(1.6, 2.2),
        spacing_m=window_width_m + rng.uniform(0.7, 1.6),
        panes=(4, 4) if is_industrial else (2, int(rng.integers(1, 3))),
        is_glazed=bool(rng.random() < 0.14),
    )


def _colour(values: np.ndarray) -> Colour:
    red, green, blue = values.tolist()
    return red, green, blue


@dataclass(frozen=True, eq=False)
class Facade:
    """A drawn facade and its openings."""

    rgba: np.ndarray
    openings: tuple[Opening, ...]
    width_m: float
    height_m: float


def draw_facade(
    style: FacadeStyle, width_m: float, height_m: float, per_m: float, rng: np.random.Generator
) -> Facade:
    """Draw one side of a building that faces a street."""
    canvas = WallCanvas.blank(width_m, height_m, per_m)
    draw_wall(canvas, style.wall, style.colour, rng)
    openings = _ground_floor(canvas, style, rng)
    if style.is_glazed:
        _draw_curtain(canvas, rng)
    else:
        openings += _upper_floors(canvas, style, rng)
    belt = (0.0, width_m, GROUND_FLOOR_M - 0.16, GROUND_FLOOR_M + 0.05)
    canvas.fill(belt, style.trim, strength=0.9)
    canvas.fill((0.0, width_m, belt[2] - 0.05, belt[2]), (30, 28, 28), strength=0.5)
    return Facade(canvas.rgba(), tuple(openings), width_m, height_m)


def _upper_floors(
    canvas: WallCanvas, style: FacadeStyle, rng: np.random.Generator
) -> list[Opening]:
    """Rows of windows."""
    openings = []
    count = max(int((canvas.width_m - 0.8) / style.spacing_m), 1)
    offset = (canvas.width_m - (count - 1) * style.spacing_m) / 2
    for floor in np.arange(GROUND_FLOOR_M, canvas.height_m - 2.6, FLOOR_M):
        sill = floor + 0.75
        top = min(sill + style.window_height_m, canvas.height_m - 0.5)
        for column in range(count):
            middle = offset + column * style.spacing_m
            half = style.window_width_m / 2
            opening = Opening(middle - half, middle + half, sill, top, 0.16)
            draw_window(canvas, opening, style.frame, style.panes, rng)
            openings.append(opening)
    return openings


def _draw_curtain(canvas: WallCanvas, rng: np.random.Generator) -> None:
    """Glass from the first floor to the roof, with spandrels between the floors."""
    for floor in np.arange(GROUND_FLOOR_M, canvas.height_m - 0.4, FLOOR_M):
        top = min(floor + FLOOR_M, canvas.height_m)
        columns = max(round(canvas.width_m / 1.5), 1)
        for column in range(columns):
            x0, x1 = canvas.width_m * column / columns, canvas.width_m * (column + 1) / columns
            draw_glass(canvas, (x0, x1, floor + 0.9, top), rng)
            canvas.fill((x0, x1, floor, floor + 0.9), (58, 74, 84), gloss=0.8)
            canvas.fill((x0 - 0.03, x0 + 0.03, floor, top), (150, 154, 156))
        canvas.fill((0, canvas.width_m, floor + 0.86, floor + 0.92), (150, 154, 156))


def _ground_floor(
    canvas: WallCanvas, style: FacadeStyle, rng: np.random.Generator
) -> list[Opening]:
    """Doors with shop windows, roller gates or plain windows between them."""
    openings = []
    top = GROUND_FLOOR_M - 1.05
    bays = max(round(canvas.width_m / 4.2), 1)
    bay_m = canvas.width_m / bays
    door_bay = int(rng.integers(bays))
    for bay in range(bays):
        left, right = bay * bay_m + 0.35, (bay + 1) * bay_m - 0.35
        if bay == door_bay:
            door = Opening(left, left + 1.15, 0.0, top, 0.3)
            draw_door(canvas, door, _colour(rng.uniform(30, 150, 3)), rng)
            openings.append(door)
            left += 1.15 + 0.3
        if right - left < 0.8:
            continue
        opening = Opening(left, right, 0.0, top, 0.22)
        if style.ground_floor == "shop":
            draw_shop_window(canvas, opening, style.frame, rng)
        elif style.ground_floor == "gate":
            grey = rng.uniform(90, 170)
            draw_gate(canvas, opening, (grey, grey, grey * 1.02), rng)
        else:  # a window at eye height, so shallow that it is drawn only
            middle, half = (left + right) / 2, min(style.window_width_m, 1.8) / 2
            window = Opening(middle - half, middle + half, 1.0, top, 0.0)
            draw_window(canvas, window, style.frame, style.panes, rng)
            continue
        openings.append(opening)
    return openings


def add_facade(
    builder: MeshBuilder,
    facade: Facade,
    origin: np.ndarray,
    right: np.ndarray,
    surface: int,
    *,
    is_flat: bool = False,
) -> None:
    """Hang a facade up in the world.

    `origin` is its lower left corner, `right` a unit vector to the right, both as seen from the
    street; a flat one has no recesses (far buildings).
    """
    up = np.array([0.0, 0.0, 1.0])
    panel = _Panel(builder, facade, np.asarray(origin, float), right, np.cross(right, up), surface)
    if is_flat or not facade.openings:
        panel.flat((0.0, facade.width_m, 0.0, facade.height_m))
        return
    bands = sorted({(opening.z0, opening.z1) for opening in facade.openings})
    below = 0.0
    for z0, z1 in bands:
        panel.flat((0.0, facade.width_m, below, z0))
        left = 0.0
        row = [opening for opening in facade.openings if (opening.z0, opening.z1) == (z0, z1)]
        for opening in sorted(row, key=lambda item: item.x0):
            panel.flat((left, opening.x0, z0, z1))
            panel.recess(opening)
            left = opening.x1
        panel.flat((left, facade.width_m, z0, z1))
        below = z1
    panel.flat((0.0, facade.width_m, below, facade.height_m))


@dataclass(eq=False)
class _Panel:
    """Places rectangles of one facade in the world."""

    builder: MeshBuilder
    facade: Facade
    origin: np.ndarray
    right: np.ndarray
    outward: np.ndarray
    surface: int

    def point(self, x: float, z: float, depth_m: float = 0.0) -> np.ndarray:
        return self.origin + x * self.right + np.array([0, 0, z]) - depth_m * self.outward

    def uv(self, x: float, z: float) -> tuple[float, float]:
        return x / self.facade.width_m, 1.0 - z / self.facade.height_m

    def flat(self, rect: tuple[float, float, float, float], depth_m: float = 0.0) -> None:
        x0, x1, z0, z1 = rect
        if x1 - x0 < EMPTY_M or z1 - z0 < EMPTY_M:
            return
        self.builder.quad(
            self.point(x0, z1, depth_m),
            (x1 - x0) * self.right,
            np.array([0, 0, z0 - z1]),
            self.surface,
            uv=(self.uv(x0, z1), self.uv(x1, z1), self.uv(x0, z0)),
        )

    def recess(self, opening: Opening) -> None:
        """The recessed rectangle and its four reveals, coloured like the wall beside them."""
        x0, x1, z0, z1 = opening.rect
        self.flat(opening.rect, opening.depth_m)
        inward = -opening.depth_m * self.outward
        for x, outside in ((x0, x0 - 0.06), (x1, x1 + 0.06)):
            uv = (self.uv(outside, z1), self.uv(outside, z0), self.uv(outside, z1))
            down = np.array([0, 0, z0 - z1])
            self.builder.quad(self.point(x, z1), down, inward, self.surface, uv=uv)
        for z, outside in ((z0, z0 - 0.06), (z1, z1 + 0.06)):
            if z < EMPTY_M:
                continue
            uv = (self.uv(x0, outside), self.uv(x1, outside), self.uv(x0, outside))
            across = (x1 - x0) * self.right
            self.builder.quad(self.point(x0, z), across, inward, self.surface, uv=uv)
