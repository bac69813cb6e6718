"""Build everything of a street from its seed: geometry, surfaces, light, actors, the ego's way."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lidarpainter_models.synthetic.plan.ego_motion import EgoMotion, draw_ego_motion
from lidarpainter_models.synthetic.plan.layout import KERB_HEIGHT_M, StreetPlan, draw_plan
from lidarpainter_models.synthetic.raytracing.scene_arrays import KIND_CUT_OUT, SceneArrays
from lidarpainter_models.synthetic.textures.noise import as_rgba, fractal_noise
from lidarpainter_models.synthetic.textures.surfaces import (
    StreetClass,
    SurfaceSet,
    srgb_from_linear,
)
from lidarpainter_models.synthetic.world.buildings import Lot, add_buildings, add_skyline, draw_lots
from lidarpainter_models.synthetic.world.furniture import StreetFurniture
from lidarpainter_models.synthetic.world.ground import add_ground
from lidarpainter_models.synthetic.world.lamps import SwitchingLamps
from lidarpainter_models.synthetic.world.meshes import Mesh, MeshBuilder
from lidarpainter_models.synthetic.world.packing import light_array, pack_scene
from lidarpainter_models.synthetic.world.traffic import StreetActor, Traffic
from lidarpainter_models.synthetic.world.vegetation import (
    SPECIES,
    LeafSurfaces,
    add_hedge,
    add_species,
    add_tree,
    bark_surface,
)

ActorChange = Callable[[tuple[StreetActor, ...]], tuple[StreetActor, ...]]
"""Other actors for a street: some taken out, some elsewhere."""


@dataclass(frozen=True, eq=False)
class City:
    """All of a street."""

    plan: StreetPlan
    ego: EgoMotion
    actors: tuple[StreetActor, ...]
    """Moving ones first."""
    arrays: SceneArrays
    roots: np.ndarray
    """int32 (moving actors, postures): root nodes of their trees, the last one repeated."""
    radius_m: np.ndarray
    """float64 (moving actors)."""
    lamps: SwitchingLamps
    """Empty where every lamp stays as it is."""


def build_city(
    seed: int,
    *,
    speed_mps: tuple[float, float] | None = None,
    are_people_walking: bool = False,
    are_lamps_switching: bool = False,
    change: ActorChange | None = None,
) -> City:
    """Draw a street; each part has its own stream of random numbers.

    First and last speed of the recording car may be given, and in `change` who stands in the street
    in place of those drawn, moving ones first; all else stays.
    """
    streams = np.random.SeedSequence([seed, 20_261]).spawn(11)
    plan_rng, ground_rng, house_rng, green_rng, thing_rng, car_rng, sky_rng, ego_rng, lot_rng = (
        np.random.default_rng(stream) for stream in streams[:9]
    )
    signal_rng, brake_rng = map(np.random.default_rng, streams[9:])
    lamps = SwitchingLamps(signal_rng, brake_rng) if are_lamps_switching else SwitchingLamps()
    plan = draw_plan(plan_rng)
    surfaces, builder = SurfaceSet(), MeshBuilder()
    add_ground(builder, surfaces, plan, ground_rng)
    lots = draw_lots(plan, lot_rng)
    add_buildings(builder, surfaces, plan, lots, house_rng)
    add_skyline(builder, surfaces, plan, house_rng)
    _add_greenery(builder, surfaces, plan, lots, green_rng)
    StreetFurniture(builder, surfaces, plan, thing_rng, lamps).add_all()
    ego = draw_ego_motion(plan.line, ego_rng)
    if speed_mps is not None:
        ego = ego.at_speed(*speed_mps)
    traffic = Traffic(
        plan, ego, surfaces, car_rng, are_people_walking=are_people_walking, lamps=lamps
    )
    actors = tuple(traffic.draw())
    actors = actors if change is None else change(actors)
    light = draw_light(surfaces, plan, sky_rng)
    street, owner = _standing(builder.build(), plan, actors)
    owners = [index for index, actor in enumerate(actors) if actor.is_moving]
    moving = [(mesh, index) for index in owners for mesh in actors[index].meshes]
    arrays, roots, radius_m = pack_scene(street, owner, moving, surfaces, light)
    last = np.cumsum([len(actors[index].meshes) for index in owners])
    most = max(len(actors[index].meshes) for index in owners)
    first = np.concatenate([[0], last[:-1]])
    places = np.minimum(first[:, None] + np.arange(most), last[:, None] - 1)
    return City(plan, ego, actors, arrays, roots[places], radius_m[places].max(axis=1), lamps)


def _standing(
    street: Mesh, plan: StreetPlan, actors: tuple[StreetActor, ...]
) -> tuple[Mesh, np.ndarray]:
    """The street with everything parked in it, and the actor index of each primitive."""
    meshes, owners = [street], [np.full(len(street.surface), -1)]
    for index, actor in enumerate(actors):
        if not actor.is_moving:
            pose = actor.world_from_box(plan.line, np.zeros(1))[0]
            meshes.append(actor.meshes[0].transformed(pose))
            owners.append(np.full(len(actor.meshes[0].surface), index))
    return Mesh.joined(meshes), np.concatenate(owners)


def _add_greenery(
    builder: MeshBuilder,
    surfaces: SurfaceSet,
    plan: StreetPlan,
    lots: list[Lot],
    rng: np.random.Generator,
) -> None:
    """Street trees on both sides, and hedges, trees or fences in the gaps."""
    chosen = rng.choice(len(SPECIES), 2, replace=False)
    species = [add_species(surfaces, rng, SPECIES[int(index)]) for index in chosen]
    bark = bark_surface(surfaces, rng)
    density = rng.uniform(0.35, 0.8)
    for side, kerb in ((-1, plan.right_kerb_m), (1, plan.left_kerb_m)):
        for s in np.arange(-96.0, 210.0, 9.0):
            s = float(s) + rng.uniform(-1.5, 1.5)
            near_crossing = plan.cross_start_m - 3.5 < s < plan.cross_end_m + 3.5
            if near_crossing or rng.random() > density:
                continue
            foot = plan.line.place(s, kerb + side * 0.9, KERB_HEIGHT_M)
            leaves = species[int(rng.integers(2))]
            detail = 1.0 if -15 < s < 70 else 0.3
            add_tree(builder, foot, leaves, bark, rng, detail=detail)
    fence = _fence_surface(surfaces)
    for lot in lots:
        if lot.is_gap and lot.start_m < 160:
            _fill_gap(builder, plan, lot, (species, bark, fence), rng)


def _fill_gap(
    builder: MeshBuilder,
    plan: StreetPlan,
    lot: Lot,
    stock: tuple[list[LeafSurfaces], int, int],
    rng: np.random.Generator,
) -> None:
    """A lot between buildings: a fence or a hedge in front, a tree or two behind."""
    species, bark, fence = stock
    leaves = species[int(rng.integers(len(species)))]
    start, end = lot.start_m + 0.3, lot.end_m - 0.3
    front = lot.front_d_m + lot.side * 0.15
    if rng.random() < 0.5:
        for low, high in pairwise(np.linspace(start, end, 4)):
            first = plan.line.place(low, front, KERB_HEIGHT_M)
            second = plan.line.place(high, front, KERB_HEIGHT_M)
            length = float(np.linalg.norm(second - first))
            uv = ((0, 0), (length / 1.2, 0), (0, 1.0))
            top = first + np.array([0, 0, 1.9])
            builder.quad(top, second - first, [0, 0, -1.9], fence, uv=uv)
    else:
        first = plan.line.place(start, front + lot.side * 0.6, KERB_HEIGHT_M)
        second = plan.line.place(end, front + lot.side * 0.6, KERB_HEIGHT_M)
        add_hedge(builder, first, second, leaves, rng)
    for _ in range(int(rng.integers(1, 4))):
        place = plan.line.place(
            rng.uniform(start + 2, end - 2), front + lot.side * rng.uniform(4, 18), KERB_HEIGHT_M
        )
        add_tree(builder, place, leaves, bark, rng, detail=0.6)


def _fence_surface(surfaces: SurfaceSet) -> int:
    """Iron bars 12 cm apart between two rails, repeating every 1.2 m, 1.9 m high."""
    rows, columns = 152, 96
    opacity = np.zeros((rows, columns), np.float32)
    for bar in range(10):
        start = round(bar * columns / 10)
        opacity[:, start : start + 3] = 1
    opacity[:, :5] = 1
    opacity[8:13], opacity[-22:-17] = 1, 1
    colour = np.full((rows, columns, 3), 30.0)
    fence = as_rgba(colour, opacity)
    return surfaces.painted(fence, StreetClass.FURNITURE, repeats=True, kind=KIND_CUT_OUT)


def draw_clouds(rng: np.random.Generator, *, cover: float) -> np.ndarray:
    """Repeating cloud texture: brightness in the colour, cover in the fourth channel."""
    size = 1024
    shape = fractal_noise(rng, (size, size), (4, 4), octaves=7, persistence=0.55)
    wisps = fractal_noise(rng, (size, size), (3, 12), octaves=6, persistence=0.6)
    density = 0.7 * shape + 0.3 * wisps
    edge = np.quantile(density, 1 - cover)
    opacity = np.clip((density - edge) * 6.0, 0, 1)
    relief = np.roll(density, (9, 5), (0, 1)) - density
    bright = np.clip(0.92 + 2.0 * relief - 0.22 * opacity, 0.45, 1.0)
    colour = srgb_from_linear(bright)[..., None] * 255 * np.array([1.0, 1.0, 1.0])
    return as_rgba(colour, 0.92 * opacity)


def draw_light(surfaces: SurfaceSet, plan: StreetPlan, rng: np.random.Generator) -> np.ndarray:
    """A day: how high the sun, how warm its light, how much cloud."""
    clouds = surfaces.add_texture(draw_clouds(rng, cover=rng.uniform(0.3, 0.75)), repeats=True)
    height = plan.sun_direction[2]
    warmth = 1.0 - height
    return light_array(
        plan.sun_direction,
        sun_rgb=(2.65, 2.65 * (0.98 - 0.14 * warmth), 2.65 * (0.92 - 0.34 * warmth)),
        haze_per_m=1 / rng.uniform(900, 2400),
        cloud_texture=clouds,
        cloud_offset=(float(rng.random()), float(rng.random())),
    )
