"""People made of tubes and balls, in mid-stride or step by step, in their box frames."""

from dataclasses import dataclass

import numpy as np

from lidarpainter_models.synthetic.textures.surfaces import StreetClass, SurfaceSet
from lidarpainter_models.synthetic.world.meshes import Mesh, MeshBuilder
from lidarpainter_models.synthetic.world.solids import add_ball, add_tube

CLOTHES = (
    (40, 48, 78), (160, 40, 44), (70, 84, 60), (202, 192, 170), (30, 30, 32), (188, 138, 60),
    (96, 110, 140), (120, 60, 96),
)  # fmt: skip
MOST_LIFT_M = 0.07
SKIN = ((224, 178, 146), (150, 104, 76), (196, 146, 112), (96, 66, 50))


@dataclass(frozen=True, kw_only=True)
class Person:
    """What somebody wears and how far they step; lengths are metres."""

    coat: int
    trousers: int
    skin: int
    shoe: int
    hair: int
    stride_m: float
    """Farthest that each foot goes before and behind the hip."""
    swing_m: float
    """Farthest that each hand goes before and behind the shoulder."""
    scale: float

    @property
    def cycle_m(self) -> float:
        """The way of two steps, in which no foot slides."""
        return 4 * self.stride_m * self.scale

    def postures(self, count: int) -> tuple[tuple[Mesh, ...], np.ndarray]:
        """So many moments of a cycle of two steps, and the size of the box that holds them all.

        The origin is the centre of the box. The first posture is in mid-stride.
        """
        scale = np.diag([self.scale, self.scale, self.scale, 1.0])
        meshes = [self._standing(2 * np.pi * k / count).transformed(scale) for k in range(count)]
        corners = np.concatenate([mesh.corners().reshape(-1, 3) for mesh in meshes])
        low, high = corners.min(0), corners.max(0)
        shift = np.eye(4)
        shift[:3, 3] = -(low + high) / 2
        return tuple(mesh.transformed(shift) for mesh in meshes), high - low

    def _standing(self, phase_rad: float) -> Mesh:
        """Feet on the ground, unscaled."""
        builder = MeshBuilder()
        for side in (-1.0, 1.0):
            self._add_leg(builder, side, phase_rad)
            self._add_arm(builder, side, np.cos(phase_rad))
        add_tube(builder, (0, 0, 0.88), (0, 0, 1.45), (0.17, 0.2), self.coat, has_caps=True)
        add_ball(builder, (0, 0, 1.45), (0.15, 0.23, 0.1), self.coat)
        add_tube(builder, (0, 0, 1.45), (0.01, 0, 1.56), (0.06, 0.06), self.skin)
        add_ball(builder, (0.02, 0, 1.64), (0.1, 0.085, 0.125), self.skin)
        add_ball(builder, (0.0, 0, 1.68), (0.105, 0.095, 0.11), self.hair)
        return builder.build()

    def _add_leg(self, builder: MeshBuilder, side: float, phase_rad: float) -> None:
        """A foot that goes forward is lifted, and its knee bends."""
        reach = side * self.stride_m * np.cos(phase_rad)
        lift = MOST_LIFT_M * max(-side * np.sin(phase_rad), 0.0)
        hip = (0.0, side * 0.09, 0.92)
        knee = (reach * 0.6 + lift, side * 0.1, 0.5 + lift / 2)
        foot = (reach, side * 0.1, 0.08 + lift)
        add_tube(builder, knee, hip, (0.07, 0.095), self.trousers)
        add_tube(builder, foot, knee, (0.05, 0.07), self.trousers)
        add_ball(builder, (foot[0] + 0.05, foot[1], 0.05 + lift), (0.14, 0.05, 0.05), self.shoe)

    def _add_arm(self, builder: MeshBuilder, side: float, swing: float) -> None:
        """Each arm goes against the leg of its side."""
        back = side * self.swing_m * swing
        shoulder, elbow = (0.0, side * 0.2, 1.42), (-back * 0.4, side * 0.26, 1.14)
        hand = (-back + 0.1, side * 0.25, 0.9)
        add_tube(builder, elbow, shoulder, (0.05, 0.065), self.coat)
        add_tube(builder, hand, elbow, (0.04, 0.05), self.coat)
        add_ball(builder, hand, (0.05, 0.05, 0.06), self.skin)


def draw_person(surfaces: SurfaceSet, rng: np.random.Generator) -> Person:
    """Somebody of 1.6 to 1.9 m."""

    def cloth(colours: tuple[tuple[int, int, int], ...]) -> int:
        return surfaces.plain(colours[int(rng.integers(len(colours)))], StreetClass.PEDESTRIAN)

    return Person(  # in this order: the street of a seed stays what it is
        coat=cloth(CLOTHES),
        trousers=cloth(CLOTHES),
        skin=cloth(SKIN),
        shoe=cloth(CLOTHES[4:5]),
        stride_m=rng.uniform(0.1, 0.26),
        swing_m=rng.uniform(0.1, 0.25),
        hair=cloth(CLOTHES),
        scale=rng.uniform(0.92, 1.06),
    )
