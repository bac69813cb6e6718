"""Everything with a box: moving cars, parked cars, people; what they look like and where they go.

No moving car ever comes beside the ego car in a neighbouring lane, so that cameras shifted by 3 m
stay outside of all cars.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lidarpainter_models.synthetic.plan.car_kinds import SHAPES, CarShape
from lidarpainter_models.synthetic.plan.ego_motion import EgoMotion, Pace
from lidarpainter_models.synthetic.plan.layout import (
    KERB_HEIGHT_M,
    LANE_M,
    PARKING_M,
    SIDEWALK_M,
    StreetLine,
    StreetPlan,
)
from lidarpainter_models.synthetic.textures.cars import CarAtlas, add_car_surfaces
from lidarpainter_models.synthetic.textures.surfaces import StreetClass, SurfaceSet
from lidarpainter_models.synthetic.world.car_shapes import build_car
from lidarpainter_models.synthetic.world.lamps import Lens, SwitchingLamps, with_brake_lenses
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


KINDS = ("sedan", "sedan", "hatch", "suv", "suv", "pickup", "van")
NUM_PAINTED = 14
NEAR_M = 70.0
NUM_POSTURES = 16
WALKING_CYCLES_PER_S = 0.95
"""Walking cycles of two steps a second, as people take them; who steps short is slow."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StreetActor:
    """One boxed thing and its way along the street."""

    actor_id: str
    category: str
    size_m: np.ndarray
    """Tight length, width, height."""
    meshes: tuple[Mesh, ...]
    """One mesh in the box frame, or one for each posture of a cycle of steps."""
    start_s_m: float
    d_m: float
    pace: Pace | None = None
    """Along +s, none for what stands; negative comes towards the ego car."""
    yaw_rad: float = 0.0
    """Relative to the street."""
    ground_m: float = 0.0
    cycle_m: float = 1.0
    """The way of one cycle of steps."""
    lenses: tuple[Lens, ...] = ()
    """Lenses of lamps that switch, in the box frame."""

    @property
    def is_moving(self) -> bool:
        """Whether it ever leaves its place."""
        return self.pace is not None

    def posture(self, time_s: np.ndarray) -> np.ndarray:
        """Which of the meshes is shown at times after the first frame; int64 (times)."""
        if self.pace is None:
            return np.zeros(time_s.shape, np.int64)
        cycles = np.abs(self.pace.travelled_m(time_s)) / self.cycle_m
        return np.floor(cycles * len(self.meshes)).astype(np.int64) % len(self.meshes)

    def world_from_box(self, line: StreetLine, time_s: np.ndarray | float) -> np.ndarray:
        """(n, 4, 4) at times after the first frame."""
        along = 0.0 if self.pace is None else self.pace.travelled_m(time_s)
        poses = line.poses(self.start_s_m + along + 0 * time_s, self.d_m, self.yaw_rad)
        lift = self.ground_m + self.size_m[2] / 2
        poses[:, :3, 3] += lift * poses[:, :3, 2]
        return poses


@dataclass(eq=False)
class Traffic:
    """Draws all actors of a street."""

    plan: StreetPlan
    ego: EgoMotion
    surfaces: SurfaceSet
    rng: np.random.Generator
    are_people_walking: bool = False
    lamps: SwitchingLamps = field(default_factory=SwitchingLamps)
    actors: list[StreetActor] = field(default_factory=list)
    _painted: list[tuple[CarShape, CarAtlas]] = field(default_factory=list)
    _meshes: dict[tuple[int, bool], tuple[Mesh, np.ndarray]] = field(default_factory=dict)

    def draw(self) -> list[StreetActor]:
        """Moving ones first."""
        self._add_same_direction()
        self._add_oncoming()
        self._add_walkers()
        for _ in range(NUM_PAINTED):
            shape = SHAPES[KINDS[int(self.rng.integers(len(KINDS)))]]
            self._painted.append((shape, add_car_surfaces(self.surfaces, shape, self.rng)))
        for side in (0, 1):
            self._park_row(side)
        self._add_waiting()
        return self.actors

    def _add_car(self, kind: str, pace: Pace, **way: float) -> None:
        """A moving car of its own paint, with brake lamps where lamps switch."""
        shape = SHAPES[kind]
        atlas = add_car_surfaces(self.surfaces, shape, self.rng)
        mesh, size = build_car(shape, atlas)
        lenses: tuple[Lens, ...] = ()
        lamp = self.lamps.add_brakes()
        if lamp >= 0:
            mesh, lenses = with_brake_lenses(mesh, size, shape, self.surfaces, lamp)
        of_car = {"category": shape.category, "size_m": size, "meshes": (mesh,), "lenses": lenses}
        self._add("car", **of_car, pace=pace, **way)

    def _add(self, kind: str, **known: Any) -> None:  # noqa: ANN401 - fields of `StreetActor`
        """The next actor, named by its kind."""
        self.actors.append(StreetActor(actor_id=f"{kind}-{len(self.actors):03d}", **known))

    def _add_same_direction(self) -> None:
        """Cars ahead in the ego lane and, where it is a lane, in the one to its left."""
        rng, ego = self.rng, self.ego
        ahead, factors = rng.uniform(12.5, 17.0), np.sort(rng.uniform(1.0, 1.15, 2))
        for factor in factors:  # the faster one is in front
            self._add_car(
                KINDS[int(rng.integers(5))],
                ego.pace.times(float(factor)),
                start_s_m=ahead,
                d_m=rng.uniform(-0.15, 0.15),
            )
            ahead += rng.uniform(11, 18)
        if self.plan.left_side == "turn":
            return
        place, factors = rng.uniform(9.5, 15.0), np.sort(rng.uniform(1.02, 1.35, 2))
        for factor in factors:
            self._add_car(
                KINDS[int(rng.integers(len(KINDS)))],
                ego.pace.times(float(factor)),
                start_s_m=place,
                d_m=LANE_M + rng.uniform(-0.15, 0.15),
            )
            place += rng.uniform(13, 22)

    def _add_oncoming(self) -> None:
        """Cars that come towards the ego car beyond the double yellow line."""
        rng = self.rng
        for lane in self.plan.oncoming_d_m:
            place = rng.uniform(14, 30)
            speed = rng.uniform(7, 11)
            while place < 110:
                self._add_car(
                    KINDS[int(rng.integers(len(KINDS)))],
                    Pace(-speed, -speed),
                    start_s_m=place,
                    d_m=lane + rng.uniform(-0.15, 0.15),
                    yaw_rad=np.pi,
                )
                place += rng.uniform(17, 42) * (1.0 if place < 60 else 1.6)

    def _add_walkers(self) -> None:
        """People on both sidewalks, some of them standing."""
        rng = self.rng
        for index in range(int(rng.integers(5, 9))):
            side = -1 if index % 2 else 1
            kerb = self.plan.left_kerb_m if side > 0 else self.plan.right_kerb_m
            person = draw_person(self.surfaces, rng)
            meshes, size = person.postures(NUM_POSTURES if self.are_people_walking else 1)
            speed = float(rng.choice([-1.0, 1.0])) * rng.uniform(1.0, 1.6)
            if self.are_people_walking:
                speed = np.sign(speed) * person.cycle_m * WALKING_CYCLES_PER_S
            self._add(
                "person",
                category="pedestrian",
                size_m=size,
                meshes=meshes,
                start_s_m=rng.uniform(7, 44),
                d_m=kerb + side * rng.uniform(1.1, SIDEWALK_M - 0.7),
                pace=Pace(speed, speed),
                yaw_rad=0.0 if speed > 0 else np.pi,
                ground_m=KERB_HEIGHT_M,
                cycle_m=person.cycle_m,
            )

    def _park(self, s_m: float, d_m: float, yaw_rad: float) -> None:
        index, is_near = int(self.rng.integers(NUM_PAINTED)), -20 < s_m < NEAR_M
        shape, atlas = self._painted[index]
        if (index, is_near) not in self._meshes:
            self._meshes[index, is_near] = build_car(shape, atlas, 34 if is_near else 12)
        mesh, size = self._meshes[index, is_near]
        of_car = {"category": shape.category, "size_m": size, "meshes": (mesh,)}
        self._add("parked", **of_car, start_s_m=s_m, d_m=d_m, yaw_rad=yaw_rad)

    def _park_row(self, side: int) -> None:
        """Parked cars along one kerb, most places taken."""
        rng, plan = self.rng, self.plan
        for s in np.arange(-75.0 + 3.0, 150.0, 6.0):
            is_blocked = plan.cross_start_m - 9 < s < plan.cross_end_m + 8
            if is_blocked or rng.random() > 0.74:
                continue
            yaw = (0.0 if side == 0 else np.pi) + rng.normal(0, 0.02)
            d = plan.parking_d_m[side] + rng.normal(0, 0.06)
            self._park(float(s) + rng.uniform(-0.25, 0.25), d, yaw)

    def _add_waiting(self) -> None:
        """Cars in the cross street that wait for green."""
        plan, rng = self.plan, self.rng
        middle = (plan.cross_start_m + plan.cross_end_m) / 2
        offset = 0.25 * (plan.cross_end_m - plan.cross_start_m)
        sides = ((-1, plan.right_kerb_m, np.pi / 2), (1, plan.left_kerb_m, -np.pi / 2))
        for side, kerb, yaw in sides:
            reach = 6.5
            for _ in range(int(rng.integers(1, 3))):
                lane = middle - side * -offset
                self._park(lane, kerb + side * (reach + PARKING_M), yaw + rng.normal(0, 0.02))
                reach += rng.uniform(6.3, 7.5)
