"""What hangs on walls and stands on roofs: cornices, boards, awnings, bays, machines."""

from dataclasses import dataclass

import numpy as np

from lidarpainter_models.synthetic.textures.openings import Opening, draw_window
from lidarpainter_models.synthetic.textures.signs import (
    BLADE_NAMES,
    BOARD_COLOURS,
    SHOP_NAMES,
    billboard,
    blade_board,
    shop_board,
)
from lidarpainter_models.synthetic.textures.surfaces import StreetClass, SurfaceSet
from lidarpainter_models.synthetic.textures.walls import WallCanvas
from lidarpainter_models.synthetic.world.facades import FLOOR_M, GROUND_FLOOR_M, Facade, FacadeStyle
from lidarpainter_models.synthetic.world.meshes import MeshBuilder
from lidarpainter_models.synthetic.world.solids import add_box, add_tube

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class HungFacade:
    """A facade where it hangs, and what is added to it."""

    builder: MeshBuilder
    surfaces: SurfaceSet
    style: FacadeStyle
    facade: Facade
    origin: np.ndarray
    """Its lower left corner as seen from the street."""
    right: np.ndarray
    """Unit vector along it."""
    rng: np.random.Generator

    @property
    def outward(self) -> np.ndarray:
        """Unit vector towards the street."""
        return np.cross(self.right, UP)

    @property
    def yaw_rad(self) -> float:
        """Heading of the outward direction."""
        return float(np.arctan2(self.outward[1], self.outward[0]))

    def at(self, x: float, z: float, out_m: float) -> np.ndarray:
        """A place in front of the wall."""
        return self.origin + x * self.right + z * UP + out_m * self.outward

    def plain(self, colour: tuple[float, float, float], gloss: float = 0.0) -> int:
        """A surface of one colour."""
        red, green, blue = map(int, colour)
        return self.surfaces.plain((red, green, blue), StreetClass.BUILDING, gloss=gloss)

    def add_cornice(self) -> None:
        """A stepped ledge along the roof."""
        surface = self.plain(self.style.trim)
        for out_m, high, low in ((0.32, 0.0, 0.16), (0.2, 0.16, 0.36)):
            middle = self.facade.height_m - (high + low) / 2
            centre = self.at(self.facade.width_m / 2, middle, out_m / 2)
            size = (out_m, self.facade.width_m, low - high)
            add_box(self.builder, centre, size, surface, yaw_rad=self.yaw_rad)

    def add_boards(self) -> None:
        """Shop names above the windows and boards that stand out from the wall."""
        if self.style.ground_floor == "homes":
            return
        rng, dark = self.rng, self.plain((44, 42, 42))
        for opening in self.facade.openings:
            if opening.z0 > 0.1 or opening.x1 - opening.x0 < 2.0:
                continue
            width = min(opening.x1 - opening.x0, 5.6)
            words = SHOP_NAMES[int(rng.integers(len(SHOP_NAMES)))]
            board = shop_board(words, (width, 0.72), rng)
            faces = {"front": self.surfaces.painted(board, StreetClass.SIGN, gloss=0.6)}
            centre = self.at((opening.x0 + opening.x1) / 2, GROUND_FLOOR_M - 0.56, 0.08)
            size = (0.16, width, 0.72)
            add_box(self.builder, centre, size, dark, yaw_rad=self.yaw_rad, faces=faces)
            if rng.random() < 0.45:
                self._add_blade(opening.x0 - 0.1)

    def _add_blade(self, x: float) -> None:
        """A board across the sidewalk, read by who drives by."""
        rng = self.rng
        size = (rng.uniform(0.8, 1.15), rng.uniform(0.55, 0.95))
        words = BLADE_NAMES[int(rng.integers(len(BLADE_NAMES)))]
        board = blade_board(words, rng, size_m=size)
        face = self.surfaces.painted(board, StreetClass.SIGN, gloss=0.5)
        dark = self.plain((40, 40, 42))
        z = GROUND_FLOOR_M + rng.uniform(0.0, 0.5)
        centre, size_m = self.at(x, z, 0.25 + size[0] / 2), (size[0], 0.12, size[1])
        faces = {"left": face, "right": face}
        add_box(self.builder, centre, size_m, dark, yaw_rad=self.yaw_rad, faces=faces)
        first, last = self.at(x, z + 0.2, 0), self.at(x, z + 0.2, 0.3)
        add_tube(self.builder, first, last, (0.03, 0.03), dark)

    def add_awnings(self) -> None:
        """Striped cloth over some shop windows."""
        if self.style.ground_floor != "shop":
            return
        rng = self.rng
        for opening in self.facade.openings:
            if opening.z0 > 0.1 or opening.x1 - opening.x0 < 1.6 or rng.random() < 0.45:
                continue
            width, reach, drop = opening.x1 - opening.x0 + 0.3, rng.uniform(0.9, 1.5), 0.62
            stripes = max(round(width / 0.5), 2)
            first, second = BOARD_COLOURS[int(rng.integers(len(BOARD_COLOURS)))]
            row = np.array([first if i % 2 else second for i in range(stripes)])
            cloth = np.full((8, stripes * 8, 4), 0, np.uint8)
            cloth[..., :3] = np.repeat(row, 8, axis=0)[None]
            surface = self.surfaces.painted(cloth, StreetClass.BUILDING, translucency=0.3)
            top = self.at(opening.x0 - 0.15, GROUND_FLOOR_M - 0.98, 0.02)
            slope = reach * self.outward - drop * UP
            self.builder.quad(top, width * self.right, slope, surface)
            self.builder.quad(top + slope, width * self.right, -0.22 * UP, surface)

    def add_bays(self) -> None:
        """Bay windows that stand out above the sidewalk."""
        style, facade, rng = self.style, self.facade, self.rng
        if style.is_glazed or style.wall == "panels" or rng.random() < 0.55:
            return
        floors = int((facade.height_m - GROUND_FLOOR_M - 0.5) / FLOOR_M)
        if floors < 1 or facade.width_m < 7:
            return
        width, out_m, height = 2.3, 0.85, floors * FLOOR_M - 0.3
        canvas = WallCanvas.blank(width, height, 40.0)
        canvas.colour[:] = np.array(style.colour) * 0.55 + 0.45 * np.array(style.trim)
        for floor in range(floors):
            sill = floor * FLOOR_M + 0.7
            window = Opening(0.35, width - 0.35, sill, sill + 1.75, 0.0)
            draw_window(canvas, window, style.frame, (3, 1), rng)
            canvas.fill((0.0, width, floor * FLOOR_M, floor * FLOOR_M + 0.14), style.trim)
        surface = self.surfaces.painted(canvas.rgba(), StreetClass.BUILDING, gloss=1.0)
        count = max(int(facade.width_m / 6.5), 1)
        for index in range(count):
            x = facade.width_m * (index + 0.5) / count
            centre = self.at(x, GROUND_FLOOR_M + 0.1 + height / 2, out_m / 2)
            add_box(self.builder, centre, (out_m, width, height), surface, yaw_rad=self.yaw_rad)

    def add_roof_things(self, depth_m: float) -> None:
        """Machines, a tank, an advertisement."""
        builder, facade, rng = self.builder, self.facade, self.rng
        metal = self.plain((150, 152, 152), gloss=0.1)
        for _ in range(int(rng.integers(1, 4))):
            size = np.array([rng.uniform(1, 2.6), rng.uniform(1, 2.6), rng.uniform(0.8, 2.0)])
            x, back = rng.uniform(1.5, facade.width_m - 1.5), rng.uniform(1.5, depth_m - 2)
            centre = self.at(x, facade.height_m + size[2] / 2, -back)
            add_box(builder, centre, size, metal, yaw_rad=self.yaw_rad)
        if rng.random() < 0.2:
            wood = self.plain((104, 74, 54))
            foot = self.at(facade.width_m * 0.6, facade.height_m + 1.6, -depth_m * 0.4)
            add_tube(builder, foot, foot + 2.6 * UP, (1.3, 1.3), wood, sides=14)
            add_tube(builder, foot + 2.6 * UP, foot + 3.6 * UP, (1.4, 0.05), wood, sides=14)
            for x, y in ((-0.9, -0.9), (0.9, -0.9), (-0.9, 0.9), (0.9, 0.9)):
                leg = foot + np.array([x, y, 0])
                add_tube(builder, leg - 1.6 * UP, leg, (0.09, 0.09), wood, sides=6)
        if rng.random() < 0.22 and facade.width_m > 10 and facade.height_m < 15:
            face = self.surfaces.painted(billboard(rng), StreetClass.SIGN)
            centre = self.at(facade.width_m / 2, facade.height_m + 3.0, -1.5)
            turn = self.yaw_rad + rng.uniform(0.3, 0.8) * (1 if self.right[0] < 0 else -1)
            add_box(builder, centre, (0.25, 8.0, 4.0), metal, yaw_rad=turn, faces={"front": face})
            for x in (-2.5, 2.5):
                leg = self.at(facade.width_m / 2 + x, facade.height_m, -1.5)
                add_tube(builder, leg, leg + 1.2 * UP, (0.12, 0.12), metal, sides=8)
