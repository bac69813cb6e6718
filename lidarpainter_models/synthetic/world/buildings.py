"""Rows of buildings along the street, with gaps, corners and what hangs on their walls."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lidarpainter_models.synthetic.plan.layout import KERB_HEIGHT_M, SIDEWALK_M, StreetPlan
from lidarpainter_models.synthetic.textures.surfaces import StreetClass, Surface, SurfaceSet
from lidarpainter_models.synthetic.textures.walls import wall_tile
from lidarpainter_models.synthetic.world.facade_parts import HungFacade
from lidarpainter_models.synthetic.world.facades import (
    FLOOR_M,
    GROUND_FLOOR_M,
    Facade,
    FacadeStyle,
    add_facade,
    draw_facade,
    draw_style,
)
from lidarpainter_models.synthetic.world.meshes import MeshBuilder
from lidarpainter_models.synthetic.world.solids import add_box

TILE_M = 11.0
NEAR_FROM_M, NEAR_TO_M = -22.0, 92.0


@dataclass(frozen=True, eq=False)
class Lot:
    """A piece of street front: a building, or a gap."""

    side: int
    """-1 right, +1 left."""
    start_m: float
    end_m: float
    front_d_m: float
    is_gap: bool
    is_corner_end: bool
    """Whether its far end (along +s) looks onto the cross street."""
    is_corner_start: bool

    @property
    def is_near(self) -> bool:
        """Whether the recorded cameras come close."""
        return self.end_m > NEAR_FROM_M and self.start_m < NEAR_TO_M


def draw_lots(plan: StreetPlan, rng: np.random.Generator) -> list[Lot]:
    """Divide the street fronts."""
    lots = []
    for block, (start, end) in enumerate(plan.blocks):
        for side, kerb in ((-1, plan.right_kerb_m), (1, plan.left_kerb_m)):
            first = start + (SIDEWALK_M + 0.1 if block == 1 else 0.0)
            last = end - (SIDEWALK_M + 0.1 if block == 0 else 0.0)
            edges = [first]
            while edges[-1] < last - 22:
                edges.append(edges[-1] + rng.uniform(8.5, 19))
            edges = [*edges, last]
            for index, (low, high) in enumerate(pairwise(edges)):
                is_end = block == 0 and index == len(edges) - 2
                is_start = block == 1 and index == 0
                is_gap = not (is_end or is_start) and rng.random() < 0.16
                setback = rng.choice([0.0, 0.0, 0.05, 0.12, 0.5, 1.2])
                front = kerb + side * (SIDEWALK_M + 0.05 + setback)
                lots.append(Lot(side, low, high, front, is_gap, is_end, is_start))
    return lots


def add_buildings(
    builder: MeshBuilder,
    surfaces: SurfaceSet,
    plan: StreetPlan,
    lots: list[Lot],
    rng: np.random.Generator,
) -> None:
    """All buildings of the rows."""
    for lot in lots:
        if not lot.is_gap:
            _Building(builder, surfaces, plan, lot, rng).add()
        else:  # something closes the view behind a gap
            stretch = lot.start_m - 6, lot.end_m + 6
            back = Lot(lot.side, *stretch, lot.front_d_m + lot.side * 27, False, False, False)
            _Building(builder, surfaces, plan, back, rng).add(is_background=True)


@dataclass(eq=False)
class _Building:
    """One building being put up."""

    builder: MeshBuilder
    surfaces: SurfaceSet
    plan: StreetPlan
    lot: Lot
    rng: np.random.Generator

    def add(self, *, is_background: bool = False) -> None:
        lot, rng = self.lot, self.rng
        style = draw_style(rng)
        floors = int(rng.choice([1, 2, 2, 3, 3, 4, 5, 7])) if not is_background else 3
        if abs(lot.start_m) > 110:
            floors += int(rng.integers(0, 4))
        height = GROUND_FLOOR_M + floors * FLOOR_M + rng.uniform(0.4, 1.3)
        first = self.plan.line.place(lot.start_m, lot.front_d_m, KERB_HEIGHT_M)
        last = self.plan.line.place(lot.end_m, lot.front_d_m, KERB_HEIGHT_M)
        left_end, right_end = (last, first) if lot.side < 0 else (first, last)
        base = min(left_end[2], right_end[2]) - 0.02
        along = (right_end - left_end) * np.array([1, 1, 0])
        width = float(np.linalg.norm(along)) - 0.02
        right = along / np.linalg.norm(along)
        origin = np.array([left_end[0], left_end[1], base])
        depth = float(rng.uniform(11, 17))
        per_m = 44.0 if lot.is_near and not is_background else 16.0
        front = self._hang(style, (width, height), per_m, origin, right)
        self._add_body(style, (width, depth, height), origin, right)
        hung = HungFacade(self.builder, self.surfaces, style, front, origin, right, rng)
        hung.add_cornice()
        hung.add_roof_things(depth)
        if not is_background and lot.start_m < 150:
            hung.add_boards()
            hung.add_awnings()
            hung.add_bays()

    def _hang(
        self,
        style: FacadeStyle,
        size: tuple[float, float],
        per_m: float,
        origin: np.ndarray,
        right: np.ndarray,
    ) -> Facade:
        """Draw a facade and hang it up."""
        facade = draw_facade(style, size[0], size[1], per_m, self.rng)
        surface = self.surfaces.painted(facade.rgba, StreetClass.BUILDING, gloss=1.0)
        add_facade(self.builder, facade, origin, right, surface, is_flat=not self.lot.is_near)
        return facade

    def _add_body(
        self,
        style: FacadeStyle,
        size: tuple[float, float, float],
        origin: np.ndarray,
        right: np.ndarray,
    ) -> None:
        """Sides, back and roof; a side on the cross street is a facade of its own."""
        width, depth, height = size
        inward = -np.cross(right, [0, 0, 1.0])
        tile = wall_tile(style.wall, style.colour, self.rng, size_m=TILE_M, per_m=16.0)
        wall = self.surfaces.painted(tile, StreetClass.BUILDING, repeats=True)
        corners = [self.lot.is_corner_start, self.lot.is_corner_end]
        if self.lot.side < 0:  # the street comes from the right
            corners.reverse()
        up = np.array([0, 0, height])
        for is_left, is_corner in zip((True, False), corners, strict=True):
            foot = origin if is_left else origin + width * right
            if is_corner:
                start, ahead = (foot + depth * inward, -inward) if is_left else (foot, inward)
                self._hang(style, (depth, height), 36.0, start, ahead)
                continue
            uv = ((0, 0), (depth / TILE_M, 0), (0, height / TILE_M))
            self.builder.quad(foot + up, depth * inward, -up, wall, uv=uv)
        back = origin + depth * inward
        uv = ((0, 0), (width / TILE_M, 0), (0, height / TILE_M))
        self.builder.quad(back + up, width * right, -up, wall, uv=uv)
        roof = self.surfaces.add(Surface(semantics=StreetClass.BUILDING, tint=(0.16, 0.155, 0.15)))
        self.builder.quad(origin + up, width * right, depth * inward, roof)


def add_skyline(
    builder: MeshBuilder, surfaces: SurfaceSet, plan: StreetPlan, rng: np.random.Generator
) -> None:
    """Towers far ahead and behind, and a cross building that closes the street's end."""
    end = plan.line.place(plan.end_m + 40, 0.0)
    heading = float(plan.line.heading_at(plan.end_m))
    ahead = np.array([np.cos(heading), np.sin(heading), 0])
    left = np.array([-ahead[1], ahead[0], 0])
    for index in range(26):
        offset = rng.uniform(-240, 240)
        distance = rng.uniform(20, 240) if abs(offset) > 24 else rng.uniform(160, 260)
        size = np.array([rng.uniform(16, 34), rng.uniform(16, 34), rng.uniform(22, 115)])
        if index < 3:
            offset, distance, size[2] = (index - 1) * 34.0, 30.0, rng.uniform(12, 24)
        centre = end + ahead * distance + left * offset + np.array([0, 0, size[2] / 2 - 2])
        surface = surfaces.painted(_tower(size, rng), StreetClass.BUILDING, gloss=0.5)
        add_box(builder, centre, size, surface, yaw_rad=heading + rng.uniform(-0.3, 0.3))
    for side in (-1, 1):  # what stands at the ends of the cross street
        middle = (plan.cross_start_m + plan.cross_end_m) / 2
        kerb = plan.left_kerb_m if side > 0 else plan.right_kerb_m
        place = plan.line.place(middle, kerb + side * 84.0)
        size = np.array([40.0, 16.0, rng.uniform(12, 26)])
        surface = surfaces.painted(_tower(size, rng), StreetClass.BUILDING, gloss=0.5)
        yaw = float(plan.line.heading_at(middle))
        add_box(builder, place + np.array([0, 0, size[2] / 2 - 1]), size, surface, yaw_rad=yaw)


def _tower(size: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Texture of a tower: floors and columns of windows in a plain wall."""
    style = draw_style(rng)
    floors, columns = max(int(size[2] / 3.4), 2), max(int(size[0] / 2.6), 2)
    cell = 10
    image = np.full((floors * cell, columns * cell, 4), (*style.colour, 0), np.float32)
    lights = rng.uniform(0.55, 1.25, (floors, columns))
    glass = np.array([58, 70, 84.0])
    left = 1 if rng.random() < 0.5 else 3
    for floor in range(floors):
        for column in range(columns):
            rows = slice(floor * cell + 2, floor * cell + 8)
            pane = image[rows, column * cell + left : column * cell + cell - left + 1]
            pane[..., :3] = glass * lights[floor, column]
            pane[..., 3] = 210
    return np.clip(image, 0, 255).astype(np.uint8)
