"""The ground: road in painted stretches, kerbs, raised blocks with sidewalks, the cross street."""

from functools import partial

import numpy as np

from lidarpainter_models.synthetic.plan.layout import (
    BLOCK_DEPTH_M,
    KERB_HEIGHT_M,
    SIDEWALK_M,
    StreetPlan,
)
from lidarpainter_models.synthetic.raytracing.scene_arrays import KIND_ROAD
from lidarpainter_models.synthetic.textures.ground import asphalt_detail, lot_ground, sidewalk_slabs
from lidarpainter_models.synthetic.textures.road_paint import paint_road
from lidarpainter_models.synthetic.textures.surfaces import StreetClass, Surface, SurfaceSet
from lidarpainter_models.synthetic.world.meshes import MeshBuilder

STEP_M = 4.0
KERB_M = 0.16
SIDEWALK_TEXTURE_M = (12.0, 6.0)
STRETCHES_M = ((-8.0, 60.0), (48.0, 26.0), (100.0, 14.0))
"""Where a stretch of road texture begins, and its texels per metre."""
BEHIND_TEXELS_PER_M = 14.0


def add_ground(
    builder: MeshBuilder, surfaces: SurfaceSet, plan: StreetPlan, rng: np.random.Generator
) -> None:
    """All of the ground."""
    detail = surfaces.add_texture(asphalt_detail(rng), repeats=True)
    _add_road(builder, surfaces, plan, rng, detail)
    stones = {"detail_texture": detail, "detail_per_m": 0.45, "detail_strength": 0.35}
    asphalt = surfaces.plain((97, 96, 94), StreetClass.ROAD, **stones)
    middle = (plan.cross_start_m, plan.cross_end_m)
    for near, far in _sides(plan):
        _add_sheet(builder, plan, middle, (near, far), asphalt, height_m=0.0)
    concrete = surfaces.add_texture(sidewalk_slabs(rng, 64.0), repeats=True)
    slabs = Surface(
        semantics=StreetClass.SIDEWALK,
        texture=concrete,
        detail_texture=detail,
        detail_per_m=0.6,
        detail_strength=0.12,
    )
    kerb = surfaces.plain((150, 148, 142), StreetClass.SIDEWALK)
    lot = surfaces.painted(lot_ground(rng), StreetClass.TERRAIN, repeats=True)
    for start, end in plan.blocks:
        for near, far in _sides(plan):
            _add_block(builder, plan, (start, end), (near, far), (surfaces.add(slabs), kerb, lot))
    plain = surfaces.plain((112, 112, 98), StreetClass.TERRAIN)
    builder.quad([-1500, -1500, -1.2], [3000, 0, 0], [0, 3000, 0], plain)


def _sides(plan: StreetPlan) -> tuple[tuple[float, float], tuple[float, float]]:
    """Kerb and far end (d) of the blocks, right and left."""
    return (
        (plan.right_kerb_m, plan.right_kerb_m - BLOCK_DEPTH_M),
        (plan.left_kerb_m, plan.left_kerb_m + BLOCK_DEPTH_M),
    )


def _add_road(
    builder: MeshBuilder,
    surfaces: SurfaceSet,
    plan: StreetPlan,
    rng: np.random.Generator,
    detail: int,
) -> None:
    """The road in stretches, those near the recorded path in fine texels."""
    starts = [plan.start_m, *(start for start, _ in STRETCHES_M), plan.end_m]
    texels = [BEHIND_TEXELS_PER_M, *(per_m for _, per_m in STRETCHES_M)]
    stretches = zip(starts[:-1], starts[1:], texels, strict=True)
    for start, end, per_m in stretches:
        surface = surfaces.painted(
            paint_road(plan, rng, start, end, per_m),
            StreetClass.ROAD,
            kind=KIND_ROAD,
            detail_texture=detail,
            detail_per_m=0.45,
            detail_strength=0.4,
        )
        s = np.linspace(start, end, round((end - start) / STEP_M) + 1)
        d = np.array([plan.left_kerb_m, 0.0, plan.right_kerb_m])
        across = (plan.left_kerb_m - d) / (plan.left_kerb_m - plan.right_kerb_m)
        along = (s - start) / (end - start)
        points = plan.line.place(s[None, :], d[:, None])
        uv = np.stack(np.broadcast_arrays(along[None, :], across[:, None]), axis=-1)
        builder.grid(points, uv, surface)


def _add_sheet(
    builder: MeshBuilder,
    plan: StreetPlan,
    stretch: tuple[float, float],
    sides: tuple[float, float],
    surface: int,
    *,
    height_m: float,
    uv_m: tuple[float, float] = (1.0, 1.0),
) -> None:
    """A level sheet between two s and two d; `uv_m` is the size of the texture."""
    s = np.linspace(*stretch, max(round((stretch[1] - stretch[0]) / STEP_M), 1) + 1)
    d = np.linspace(*sides, max(round(abs(sides[1] - sides[0]) / 12.0), 1) + 1)
    points = plan.line.place(s[None, :], d[:, None], height_m)
    offset = np.abs(d - sides[0])
    uv = np.stack(np.broadcast_arrays(s[None, :] / uv_m[0], offset[:, None] / uv_m[1]), axis=-1)
    builder.grid(points, uv, surface)


def _add_block(
    builder: MeshBuilder,
    plan: StreetPlan,
    stretch: tuple[float, float],
    sides: tuple[float, float],
    surfaces: tuple[int, int, int],
) -> None:
    """A raised block: kerb stones around it, a sidewalk along its streets, a lot inside."""
    slabs, kerb, lot = surfaces
    start, end = stretch
    near, far = sides
    out = np.sign(near)
    sheet = partial(_add_sheet, builder, plan, height_m=KERB_HEIGHT_M)
    inner_near = near + out * KERB_M
    inside = near + out * SIDEWALK_M
    meets_cross_at_end = end <= plan.cross_start_m
    corner = end if meets_cross_at_end else start
    inward = -1.0 if meets_cross_at_end else 1.0
    cut = corner + inward * KERB_M
    lot_edge = corner + inward * SIDEWALK_M
    other = start if meets_cross_at_end else end
    sheet((start, end), (near, inner_near), kerb)
    sheet(_between(corner, cut), (inner_near, far), kerb)
    sheet(_between(cut, other), (inner_near, inside), slabs, uv_m=SIDEWALK_TEXTURE_M)
    sheet(_between(cut, lot_edge), (inside, far), slabs, uv_m=SIDEWALK_TEXTURE_M)
    sheet(_between(lot_edge, other), (inside, far), lot, uv_m=(16.0, 16.0))
    _add_kerb_face(
        builder, plan, (np.linspace(start, end, round((end - start) / STEP_M) + 1), near), kerb
    )
    _add_kerb_face(builder, plan, (corner, np.linspace(near, far, 8)), kerb)


def _between(one_m: float, other_m: float) -> tuple[float, float]:
    return min(one_m, other_m), max(one_m, other_m)


def _add_kerb_face(
    builder: MeshBuilder,
    plan: StreetPlan,
    path: tuple[np.ndarray | float, np.ndarray | float],
    kerb: int,
) -> None:
    """The upright side of a kerb along a path of street coordinates."""
    points = np.stack([plan.line.place(*path, KERB_HEIGHT_M), plan.line.place(*path, -0.05)])
    builder.grid(points, np.full((*points.shape[:2], 2), 0.5), kerb)
