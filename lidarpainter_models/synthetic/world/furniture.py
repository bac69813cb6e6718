"""What stands on the sidewalks: lamps, signals, signs, poles with wires, meters, bins, shelters."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from lidarpainter_models.synthetic.plan.layout import KERB_HEIGHT_M, StreetPlan
from lidarpainter_models.synthetic.raytracing.scene_arrays import KIND_CUT_OUT
from lidarpainter_models.synthetic.textures.signs import (
    STREET_NAMES,
    blade_board,
    parking_plate,
    speed_plate,
    stop_plate,
    street_name_plate,
)
from lidarpainter_models.synthetic.textures.surfaces import StreetClass, SurfaceSet, tint_from_bytes
from lidarpainter_models.synthetic.world.lamps import Lens, SwitchingLamps
from lidarpainter_models.synthetic.world.meshes import MeshBuilder
from lidarpainter_models.synthetic.world.solids import add_ball, add_box, add_tube

UP = np.array([0.0, 0.0, 1.0])
EDGE_M = 0.55
WIRE_RADIUS_M = 0.022
LIT = 2.6
"""Emission of the lamps of signals, on their full colour."""
LENS_RADII_M = (0.05, 0.13, 0.13)
SUNK_M = 0.02
"""How far the middle of a round glass lies behind where a hood begins."""


@dataclass(eq=False)
class StreetFurniture:
    """Puts things on both sidewalks."""

    builder: MeshBuilder
    surfaces: SurfaceSet
    plan: StreetPlan
    rng: np.random.Generator
    lamps: SwitchingLamps = field(default_factory=SwitchingLamps)

    def plain(self, colour: tuple[int, int, int], kind: StreetClass, **light: float) -> int:
        """A surface of one colour, which may shine."""
        return self.surfaces.plain(colour, kind, gloss=0.15, **light)

    def foot(self, s_m: float, side: int, inset_m: float = EDGE_M) -> np.ndarray:
        """A place on the sidewalk; `inset_m` from the kerb."""
        kerb = self.plan.left_kerb_m if side > 0 else self.plan.right_kerb_m
        return self.plan.line.place(s_m, kerb + side * inset_m, KERB_HEIGHT_M)

    def axes(self, s_m: float, side: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Unit vectors ahead and towards the road, and the heading of the street."""
        heading = float(self.plan.line.heading_at(s_m))
        ahead = np.array([np.cos(heading), np.sin(heading), 0])
        left = np.array([-np.sin(heading), np.cos(heading), 0])
        return ahead, -side * left, heading

    def add_all(self) -> None:
        """Everything along the whole street."""
        for side in (-1, 1):
            self._add_lamps(side)
            self._add_small_things(side)
        self._add_signals()
        self._add_crossing_signs()
        if self.rng.random() < 0.7:
            self._add_wires(int(self.rng.choice([-1, 1])))
        self._add_shelter()

    def is_free(self, s_m: float) -> bool:
        """Whether a place lies within a block, clear of its corner."""
        return not self.plan.cross_start_m - 1.5 < s_m < self.plan.cross_end_m + 1.5

    def _add_lamps(self, side: int) -> None:
        metal = self.plain((72, 78, 76), StreetClass.POLE)
        glow = self.plain((244, 240, 224), StreetClass.POLE, emission=0.4)
        offset = 0.0 if side > 0 else 13.0
        for s in np.arange(-93.0 + offset, 200, 27.0):
            if not self.is_free(s):
                continue
            foot, (_, inward, heading) = self.foot(s, side), self.axes(s, side)
            add_tube(self.builder, foot, foot + 7.6 * UP, (0.1, 0.06), metal)
            add_tube(self.builder, foot, foot + 0.7 * UP, (0.15, 0.13), metal)
            tip = foot + 8.2 * UP + 2.0 * inward
            add_tube(self.builder, foot + 7.55 * UP, tip, (0.05, 0.04), metal, sides=7)
            size = (0.22, 0.7, 0.12)
            add_box(self.builder, tip, size, metal, yaw_rad=heading, faces={"bottom": glow})
            if self.rng.random() < 0.5:
                self._add_banner(foot + 4.6 * UP + 0.55 * inward, heading)

    def _add_banner(self, centre: np.ndarray, heading: float) -> None:
        """Cloth on a lamp post with the town's event."""
        words = ("JAZZ", "OPERA", "FAIR", "SPORT")[int(self.rng.integers(4))]
        cloth = blade_board(words, self.rng, size_m=(0.75, 1.6))
        face = self.surfaces.painted(cloth, StreetClass.SIGN)
        faces = {"front": face, "back": face}
        grey = self.plain((90, 90, 90), StreetClass.SIGN)
        add_box(self.builder, centre, (0.03, 0.75, 1.6), grey, yaw_rad=heading, faces=faces)

    def _add_post(self, foot: np.ndarray, height_m: float) -> None:
        metal = self.plain((150, 152, 150), StreetClass.POLE)
        add_tube(self.builder, foot, foot + height_m * UP, (0.035, 0.035), metal, sides=7)

    def _add_plate(
        self,
        centre: np.ndarray,
        size_m: tuple[float, float],
        rgba: np.ndarray,
        yaw_rad: float,
        *,
        both: bool = False,
    ) -> None:
        """A thin plate whose front looks along `yaw_rad`."""
        face = self.surfaces.painted(rgba, StreetClass.SIGN, gloss=0.5)
        back = self.plain((128, 130, 130), StreetClass.SIGN)
        faces = {"front": face, "back": face if both else back}
        size = (0.025, *size_m)
        add_box(self.builder, centre, size, back, yaw_rad=yaw_rad, faces=faces)

    def _add_small_things(self, side: int) -> None:
        """Parking signs, meters, hydrants, bins and letter boxes."""
        s = -58.0
        makers = (
            self._add_meter, self._add_meter, self._add_meter, self._add_parking_sign,
            self._add_hydrant, self._add_bin, self._add_letter_box,
        )  # fmt: skip
        while s < 130:
            s += self.rng.uniform(3.2, 7.5)
            if self.is_free(s):
                makers[int(self.rng.integers(len(makers)))](s, side)

    def _add_meter(self, s: float, side: int) -> None:
        foot = self.foot(s, side, 0.4)
        self._add_post(foot, 1.05)
        head = self.plain((66, 70, 76), StreetClass.FURNITURE)
        add_ball(self.builder, foot + 1.2 * UP, (0.09, 0.07, 0.17), head)

    def _add_parking_sign(self, s: float, side: int) -> None:
        foot = self.foot(s, side, 0.4)
        self._add_post(foot, 2.6)
        _, _, heading = self.axes(s, side)
        facing = heading + (np.pi if side < 0 else 0.0) + self.rng.normal(0, 0.12)
        plate = parking_plate(self.rng)
        self._add_plate(foot + 2.35 * UP, (0.4, 0.56), plate, facing, both=True)
        if self.rng.random() < 0.35:
            limit = int(self.rng.choice([25, 30, 35]))
            self._add_plate(foot + 1.65 * UP, (0.6, 0.75), speed_plate(limit), facing)

    def _add_hydrant(self, s: float, side: int) -> None:
        foot = self.foot(s, side, 0.45)
        red = self.plain((178, 36, 30), StreetClass.FURNITURE)
        add_tube(self.builder, foot, foot + 0.6 * UP, (0.11, 0.1), red)
        add_ball(self.builder, foot + 0.6 * UP, (0.13, 0.13, 0.12), red)
        ahead, _, _ = self.axes(s, side)
        middle = foot + 0.42 * UP
        add_tube(self.builder, middle - 0.18 * ahead, middle + 0.18 * ahead, (0.06, 0.06), red)

    def _add_bin(self, s: float, side: int) -> None:
        foot = self.foot(s, side, 0.6)
        colours = ((44, 84, 60), (50, 52, 56), (36, 70, 120))
        body = self.plain(colours[int(self.rng.integers(3))], StreetClass.FURNITURE)
        add_tube(self.builder, foot, foot + 0.85 * UP, (0.24, 0.3), body, sides=14)
        add_ball(self.builder, foot + 0.85 * UP, (0.31, 0.31, 0.16), body)

    def _add_letter_box(self, s: float, side: int) -> None:
        foot = self.foot(s, side, 0.7)
        blue = self.plain((28, 60, 128), StreetClass.FURNITURE)
        _, _, heading = self.axes(s, side)
        add_box(self.builder, foot + 0.62 * UP, (0.5, 0.5, 0.9), blue, yaw_rad=heading)
        ahead, _, _ = self.axes(s, side)
        low, high = foot + 1.05 * UP - 0.25 * ahead, foot + 1.05 * UP + 0.25 * ahead
        add_tube(self.builder, low, high, (0.25, 0.25), blue, sides=14, has_caps=True)
        for x, y in ((-0.2, -0.2), (0.2, -0.2), (-0.2, 0.2), (0.2, 0.2)):
            leg = foot + np.array([x, y, 0])
            add_tube(self.builder, leg, leg + 0.2 * UP, (0.03, 0.03), blue, sides=5)

    def _add_signals(self) -> None:
        """A mast over the road on the far side of the crossing, one low signal at each corner."""
        plan, switching = self.plan, self.lamps.add_signals()
        far = plan.cross_end_m + 1.9
        metal = self.plain((60, 66, 64), StreetClass.POLE)
        foot, (_, inward, heading) = self.foot(far, -1, 0.8), self.axes(far, -1)
        add_tube(self.builder, foot, foot + 6.2 * UP, (0.13, 0.1), metal)
        reach = abs(plan.right_kerb_m) + 0.8 + 4.2
        tip = foot + 6.4 * UP + reach * inward
        add_tube(self.builder, foot + 5.9 * UP, tip, (0.08, 0.045), metal)
        for along in (reach - 0.4, reach - 4.1):
            centre = foot + (5.9 + 0.5 * along / reach) * UP + along * inward
            self._add_lights(centre - 0.55 * UP, heading + np.pi, switching)
        self._add_lights(foot + 3.0 * UP + 0.2 * inward, heading + np.pi, switching)
        name = STREET_NAMES[int(self.rng.integers(len(STREET_NAMES)))]
        sign = foot + 6.05 * UP + 2.6 * inward
        plate = street_name_plate(name)
        self._add_plate(sign + 0.35 * UP, (1.9, 0.44), plate, heading + np.pi, both=True)
        near = plan.cross_start_m - 1.9
        foot, (_, inward, heading) = self.foot(near, 1, 0.8), self.axes(near, 1)
        add_tube(self.builder, foot, foot + 3.7 * UP, (0.08, 0.07), metal)
        self._add_lights(foot + 3.1 * UP + 0.2 * inward, heading, switching)
        self._add_lights(foot + 3.1 * UP - 0.25 * inward, heading + np.pi, switching)

    def _add_lights(self, centre: np.ndarray, yaw_rad: float, switching: dict[str, int]) -> None:
        """A black box with three lamps: green is lit, or whichever of those that switch."""
        black = self.plain((20, 21, 22), StreetClass.SIGN)
        add_box(self.builder, centre, (0.26, 0.36, 1.05), black, yaw_rad=yaw_rad)
        front = np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0])
        lamps = {"red": (236, 44, 36), "yellow": (240, 180, 40), "green": (60, 232, 150)}
        for row, (name, colour) in enumerate(lamps.items()):
            place = centre + 0.14 * front + (0.33 - 0.33 * row) * UP
            if switching:
                self._add_lens(place, yaw_rad, colour, switching.get(name, -1))
            else:
                lit = name == "green"
                shown = colour if lit else _unlit(colour)
                surface = self.plain(shown, StreetClass.SIGN, emission=LIT * lit)
                add_ball(self.builder, place, (0.05, 0.05, 0.12), surface, rows=8)
            back, end = place + 0.02 * UP, place + 0.2 * front + 0.02 * UP
            add_tube(self.builder, back, end, (0.15, 0.15), black)

    def _add_lens(
        self, place: np.ndarray, yaw_rad: float, colour: tuple[int, int, int], lamp: int
    ) -> None:
        """A round glass that looks along `yaw_rad` and shows a lamp, or stays dark (-1)."""
        dark = _unlit(colour)
        brighter = max(tint_from_bytes(colour)) / max(tint_from_bytes(dark))
        emission = LIT * brighter if lamp >= 0 else 0.0
        surface = self.plain(dark, StreetClass.SIGN, emission=emission, lamp=lamp)
        glass = MeshBuilder()
        add_ball(glass, (0.0, 0.0, 0.0), LENS_RADII_M, surface, rows=8)
        pose = np.eye(4)
        pose[:2, 0] = np.cos(yaw_rad), np.sin(yaw_rad)
        pose[:2, 1] = -np.sin(yaw_rad), np.cos(yaw_rad)
        pose[:3, 3] = place - SUNK_M * pose[:3, 0]
        mesh = glass.build().transformed(pose)
        self.builder.add(mesh)
        if lamp >= 0:
            self.lamps.standing.append(Lens.of_mesh(lamp, mesh))

    def _add_crossing_signs(self) -> None:
        """Street names and a stop sign for who comes out of the cross street."""
        plan, rng = self.plan, self.rng
        for side, s in ((-1, plan.cross_start_m - 1.2), (1, plan.cross_end_m + 1.2)):
            foot, (_, _, heading) = self.foot(s, side, 1.4), self.axes(s, side)
            self._add_post(foot, 3.0)
            for turn, z in ((0.0, 2.95), (np.pi / 2, 2.6)):
                plate = street_name_plate(STREET_NAMES[int(rng.integers(len(STREET_NAMES)))])
                centre = foot + z * UP
                self._add_plate(centre, (1.3, 0.3), plate, heading + turn + np.pi, both=True)
            face = self.surfaces.painted(stop_plate(), StreetClass.SIGN, kind=KIND_CUT_OUT)
            outward = heading + (np.pi / 2 if side > 0 else -np.pi / 2)
            right = np.array([-np.sin(outward), np.cos(outward), 0])
            front = np.array([np.cos(outward), np.sin(outward), 0])
            corner = foot + 2.35 * UP - 0.375 * right + 0.05 * front
            self.builder.quad(corner, 0.75 * right, -0.75 * UP, face)

    def _add_wires(self, side: int) -> None:
        """Wooden poles with cross arms, a transformer here and there, and sagging wires."""
        wood = self.plain((92, 76, 62), StreetClass.POLE)
        black = self.plain((26, 26, 28), StreetClass.POLE)
        grey = self.plain((140, 144, 146), StreetClass.POLE)
        tops = []
        for s in np.arange(-70.0 + self.rng.uniform(0, 10), 190, 34.0):
            if not self.is_free(s):
                before, after = self.plan.cross_start_m - 2.0, self.plan.cross_end_m + 2.0
                s = before if s - before < after - s else after
            foot, (ahead, inward, _) = self.foot(s, side, 0.75), self.axes(s, side)
            add_tube(self.builder, foot, foot + 11.0 * UP, (0.16, 0.11), wood)
            for height, reach in ((10.4, 1.25), (9.3, 1.0)):
                arm, along = foot + height * UP, reach * inward
                add_tube(self.builder, arm - along, arm + along, (0.06, 0.06), wood, sides=6)
            if self.rng.random() < 0.5:
                can = foot + 7.9 * UP + 0.35 * ahead
                add_tube(self.builder, can, can + 0.9 * UP, (0.24, 0.24), grey, has_caps=True)
            spots = [10.5 * UP - 1.15 * inward, 10.5 * UP + 1.15 * inward, 9.4 * UP + 0.9 * inward]
            tops.append([foot + spot for spot in spots] + [foot + 7.4 * UP])
        share = np.linspace(0, 1, 9)
        for first, second in pairwise(tops):
            for start, end in zip(first, second, strict=True):
                path = start + share[:, None] * (end - start)
                path[:, 2] -= 3.2 * share * (1 - share)
                for low, high in pairwise(path):
                    radii = (WIRE_RADIUS_M, WIRE_RADIUS_M)
                    add_tube(self.builder, low, high, radii, black, sides=4)

    def _add_shelter(self) -> None:
        """A bus stop: a roof on posts, a bench, a back wall with a poster."""
        side = int(self.rng.choice([-1, 1]))
        s = self.rng.uniform(20, 38)
        metal = self.plain((56, 60, 64), StreetClass.FURNITURE)
        ahead, inward, heading = self.axes(s, side)
        middle = self.foot(s, side, 1.9)
        add_box(self.builder, middle + 2.5 * UP, (4.2, 1.5, 0.12), metal, yaw_rad=heading)
        for x in (-2.0, 2.0):
            for y in (-0.65, 0.65):
                foot = middle + x * ahead + y * inward
                add_tube(self.builder, foot, foot + 2.5 * UP, (0.04, 0.04), metal, sides=6)
        bench = middle - 0.35 * inward + 0.45 * UP
        wood = self.plain((126, 88, 58), StreetClass.FURNITURE)
        add_box(self.builder, bench, (2.6, 0.4, 0.06), wood, yaw_rad=heading)
        words = ("MOVIES", "MUSEUM", "FLY NOW", "LEMONADE")[int(self.rng.integers(4))]
        poster = blade_board(words, self.rng, size_m=(1.2, 1.8))
        face = self.surfaces.painted(poster, StreetClass.SIGN, gloss=0.8)
        for end in (-2.0, 2.0):
            place = middle + end * ahead + 1.3 * UP
            faces = {"front": face, "back": face}
            add_box(self.builder, place, (0.08, 1.2, 1.8), metal, yaw_rad=heading, faces=faces)


def _unlit(colour: tuple[int, int, int]) -> tuple[int, int, int]:
    """What is seen of the glass of a signal while its lamp is off."""
    red, green, blue = (int(value * 0.28) for value in colour)
    return red, green, blue
