"""Turn coloured LiDAR points into the sparse image the painter starts from.

Street points of a window of frames stand in the world; actor points of the whole sequence are
carried by the pose of their track. Frames: world x forward, y left, z up; camera x right, y down,
z forward; depth is camera z in metres.

Visibility takes three steps. A z-buffer of discs as large as the beams are apart gives a closed
surface. A point is hidden when nearer surface surrounds it in all directions around its pixel
(after Pintus et al. 2011, who open a cone instead), which culls background between the scan lines
of a foreground yet keeps a road seen at a grazing angle. The points left are blended where they
meet the nearest direct hit of a pixel, so silhouettes stay sharp and discs do not show. A surface
holds infinity, a depth image 0, where there is nothing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.point_blend import blend_points
from lidarpainter_models.kernels.point_splat import splat_points
from lidarpainter_models.lidar.lidar_map import LidarMap, MapPoints
from lidarpainter_models.lidar.points_in_view import read_in_image, with_margin
from lidarpainter_models.lidar.points_on_actors import MovingBoxes

WINDOW_S = 1.0
"""Street points measured this long before or after the image are drawn first; where no
sweep is so near in time, counted from the nearest."""
REACH_S = 10.0
"""Street points up to this much older or newer fill what the window leaves open: the street
stands still, but what moved through it unboxed does not."""
RECENCY_S = 0.4  # a point this much older weighs e times less in the blend
BEAM_SPACING_RAD = 0.004
"""Angle between neighbouring returns; times the range of a point, its footprint."""
MAX_RADIUS_RAD = 0.006  # no disc is wider than this angle to each side: 3 px at 500 px focal length
MIN_RADIUS_PX = 0.75
"""Just over half a diagonal, so that a point always covers the pixel it falls into."""
HIDDEN_REACH_RAD = 0.012
"""How far around a pixel nearer surface is looked for: 6 px at 500 px focal length."""
HIDDEN_TOLERANCE = 0.1  # nearer means by more than this share of the depth
SURFACE_TOLERANCE = 0.06
"""A point is blended where it meets the surface of a pixel within this share of its depth."""
GAP_WIDENING = 2.5  # discs grow by this factor where covered pixels surround a gap, and only there
GAP_DIRECTIONS = 6  # of the 8 directions, how many must meet covered pixels to make a gap
GAP_DEPTH_RANGE = 0.15
"""The pixels met around a gap differ in depth by at most this share: one surface."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LidarImage:
    """LiDAR seen by a camera."""

    rgb: Float[Tensor, "height width 3"]
    """0 where no coloured point hits."""
    depth_m: Float[Tensor, "height width"]
    """Camera z of the surface hit, coloured or not; 0 = none."""
    hit: Bool[Tensor, "height width"]
    """Where a coloured point gave `rgb`."""


class ViewPoints(NamedTuple):
    """Points in one view: continuous pixels, depth, and what they carry."""

    positions_uv: Float[Tensor, "points 2"]
    depth_m: Float[Tensor, " points"]
    radius_px: Float[Tensor, " points"]
    rgb_u8: UInt8[Tensor, "points 3"]
    has_colour: Bool[Tensor, " points"]
    age_s: Float[Tensor, " points"]

    def keep(self, kept: Bool[Tensor, " points"]) -> "ViewPoints":
        """The points that are marked."""
        rows = kept.nonzero()[:, 0]
        return ViewPoints(*(field.index_select(0, rows) for field in self))

    @classmethod
    def concatenate(cls, parts: Sequence["ViewPoints"]) -> "ViewPoints":
        """All points of several parts, in their order."""
        if len(parts) == 1:
            return parts[0]
        return cls(*(torch.cat(fields) for fields in zip(*parts, strict=True)))


def render_lidar(
    lidar_map: LidarMap, actors: MovingBoxes, camera: Camera, timestamp_ns: int
) -> LidarImage:
    """Splat the street around a time and the actors present then into a camera.

    Only actors that have points in the map and are present at `timestamp_ns` are drawn.
    """
    # what stands just outside the image hides and covers pixels inside
    margin_px = max(2, round(HIDDEN_REACH_RAD * camera.fx_px))
    recent, older = _points_around(lidar_map, actors, camera, timestamp_ns, margin_px)
    image = _image(recent, older, with_margin(camera, margin_px), margin_px)
    image = image[margin_px:-margin_px, margin_px:-margin_px]
    hit = image[..., 3] > 0
    return LidarImage(
        rgb=torch.where(hit[..., None], image[..., :3] / image[..., 3:4], 0),
        depth_m=image[..., 4],
        hit=hit,
    )


def _image(
    recent: ViewPoints, older: ViewPoints, camera: Camera, reach_px: int
) -> Float[Tensor, "height width 5"]:
    """Recent points first, older ones where those leave the image open, then gaps closed."""
    surface = _surface(recent, camera, recent.radius_px.round())
    recent = _without_hidden(recent, surface, reach_px)
    image = _blend(recent, torch.ones_like(surface, dtype=torch.bool), camera)
    is_open = image[..., 4] == 0
    older = older.keep(_at(spread(is_open, reach_px), older))
    surface = torch.minimum(surface, _surface(older, camera, older.radius_px.round()))
    older = _without_hidden(older, surface, reach_px)
    image = image + _blend(older, is_open, camera)
    return image + _fill_gaps(image[..., 4], (recent, older), camera)


def _points_around(
    lidar_map: LidarMap, actors: MovingBoxes, camera: Camera, timestamp_ns: int, margin_px: int
) -> tuple[ViewPoints, ViewPoints]:
    """Every map point within reach of the time that is in the image or its margin, hidden or not.

    First the recent ones: street points within the window of the newest sweep at that time, and
    all actors'.
    """
    newest_ns = lidar_map.newest_age_ns(timestamp_ns)
    window_ns, reach_ns = (newest_ns + round(limit_s * 1e9) for limit_s in (WINDOW_S, REACH_S))
    where = partial(_Projected.of, camera=camera, time_ns=timestamp_ns, margin_px=margin_px)
    street = where(lidar_map.street, stand_still=True)
    recent = [street.points(street.age_ns <= window_ns)]
    older = street.points((street.age_ns > window_ns) & (street.age_ns <= reach_ns))
    seen = _actors_in(with_margin(camera, margin_px), lidar_map, actors, timestamp_ns)
    if len(seen):
        placed = where(seen, stand_still=False)
        recent.append(placed.points(torch.ones_like(placed.age_ns, dtype=torch.bool)))
    return ViewPoints.concatenate(recent), older


def _actors_in(
    image: Camera, lidar_map: LidarMap, actors: MovingBoxes, timestamp_ns: int
) -> MapPoints:
    """The points of the actors that an image may show, in the world where they are at its time."""
    mapped = [
        (lidar_map.actors[track.actor_id], world_from_box)
        for track, world_from_box in actors.placed(timestamp_ns)
        if track.actor_id in lidar_map.actors
    ]
    if not mapped:
        return MapPoints.concatenate([])
    centres = torch.stack([world_from_box[:3, 3] for _, world_from_box in mapped])
    reach_m = torch.tensor([points.reach_m for points, _ in mapped])
    seen = image.may_see(centres, reach_m).nonzero()[:, 0].tolist()
    return MapPoints.concatenate([mapped[number][0].moved(mapped[number][1]) for number in seen])


class _Projected(NamedTuple):
    """Points of the street or of actors in the image: which, and where."""

    body: MapPoints
    rows: Int[Tensor, " points"]
    positions_uv: Float[Tensor, "points 2"]
    depth_m: Float[Tensor, " points"]
    age_ns: Int[Tensor, " points"]
    focal_px: float

    @classmethod
    def of(
        cls, body: MapPoints, *, stand_still: bool, camera: Camera, time_ns: int, margin_px: int
    ) -> "_Projected":
        """Bring points of the world into the image and its margin; those outside are dropped."""
        seen_from = camera.camera_from_world
        rows, positions_uv, depth_m = read_in_image(
            body.xyz_m, seen_from, camera, stand_still=stand_still, margin_px=margin_px
        )
        age_ns = (body.timestamp_ns.index_select(0, rows) - time_ns).abs()
        focal_px = (camera.fx_px + camera.fy_px) / 2
        return cls(body, rows, positions_uv, depth_m, age_ns, focal_px)

    def points(self, chosen: Bool[Tensor, " points"]) -> ViewPoints:
        """Those that are marked, with what they carry."""
        places = chosen.nonzero()[:, 0]
        rows, depth_m = self.rows.index_select(0, places), self.depth_m.index_select(0, places)
        range_m = self.body.range_m.index_select(0, rows)
        max_radius_px = max(MAX_RADIUS_RAD * self.focal_px, MIN_RADIUS_PX)
        half_footprint_px = range_m * (BEAM_SPACING_RAD * self.focal_px / 2) / depth_m
        return ViewPoints(
            positions_uv=self.positions_uv.index_select(0, places),
            depth_m=depth_m,
            radius_px=half_footprint_px.clamp(MIN_RADIUS_PX, max_radius_px),
            rgb_u8=self.body.rgb_u8.index_select(0, rows),
            has_colour=self.body.has_colour.index_select(0, rows),
            age_s=self.age_ns.index_select(0, places).to(torch.float32) * 1e-9,
        )


def _without_hidden(
    points: ViewPoints, surface: Float[Tensor, "height width"], reach_px: int
) -> ViewPoints:
    """The same points, at no depth where nearer surface surrounds them: nothing draws those."""
    is_hidden = _at(curtain(surface, reach_px), points) < points.depth_m * (1 - HIDDEN_TOLERANCE)
    return points._replace(depth_m=torch.where(is_hidden, torch.inf, points.depth_m))


def _blend(
    points: ViewPoints, wanted: Bool[Tensor, "height width"], camera: Camera
) -> Float[Tensor, "height width 5"]:
    """Mean of the points on the surface of each wanted pixel: the columns of `_means_on`."""
    direct = _surface(points, camera, torch.zeros_like(points.radius_px))
    covered = _surface(points, camera, points.radius_px.ceil())
    surface = torch.where(direct.isfinite(), direct, covered)
    return _means_on(torch.where(wanted & surface.isfinite(), surface, 0), points)


def _fill_gaps(
    depth_m: Float[Tensor, "height width"], parts: Sequence[ViewPoints], camera: Camera
) -> Float[Tensor, "height width 5"]:
    """What wider discs give in the gaps of a surface; 0 elsewhere."""
    reach_px = math.ceil(GAP_WIDENING * MAX_RADIUS_RAD * camera.fx_px)
    gaps = surface_gaps(depth_m, reach_px)
    around = spread(gaps, reach_px)
    wide = ViewPoints.concatenate(
        [part.keep(_at(around, part) & part.depth_m.isfinite()) for part in parts]
    )
    wide = wide._replace(radius_px=wide.radius_px * GAP_WIDENING)
    surface = _surface(wide, camera, wide.radius_px.ceil())
    return _means_on(torch.where(gaps & surface.isfinite(), surface, 0), wide)


def _surface(
    points: ViewPoints, camera: Camera, radius_px: Float[Tensor, " points"]
) -> Float[Tensor, "height width"]:
    """Depth of the nearest disc in each pixel, infinity where there is none."""
    nearest = splat_points(
        points.positions_uv,
        points.depth_m,
        height_px=camera.height_px,
        width_px=camera.width_px,
        radius_px=radius_px.to(torch.int64),
    ).to(torch.int64)
    beyond = points.depth_m.new_full((1,), torch.inf)
    return torch.cat([points.depth_m, beyond])[nearest]  # index -1 takes infinity


def _at(image: Shaped[Tensor, "height width"], points: ViewPoints) -> Shaped[Tensor, " points"]:
    """The values of an image in the pixels of the points."""
    column, row = points.positions_uv.int().unbind(-1)
    return image.reshape(-1).index_select(0, row * image.shape[1] + column)


def _means_on(
    surface_depth_m: Float[Tensor, "height width"], points: ViewPoints
) -> Float[Tensor, "height width 5"]:
    """Means of coloured rgb, share of coloured points and depth on a surface; 0 off it."""
    newest_s = points.age_s.min() if len(points.age_s) else 0.0
    points = points.keep(_touches(surface_depth_m, points))  # few do: columns are made of these
    recent = torch.exp(-(points.age_s - newest_s) / RECENCY_S).clamp(min=1e-6)
    coloured = points.has_colour.to(torch.float32)[:, None]
    rgb = points.rgb_u8.to(torch.float32) / 255 * coloured
    return blend_points(
        points.positions_uv,
        points.depth_m,
        torch.cat([rgb, coloured, points.depth_m[:, None]], dim=-1),
        surface_depth_m,
        weight=recent,
        radius_px=points.radius_px,
        tolerance=SURFACE_TOLERANCE,
    )[0]


def _touches(
    surface_depth_m: Float[Tensor, "height width"], points: ViewPoints
) -> Bool[Tensor, " points"]:
    """Which points may lie on the surface of a pixel that they reach, and some more."""
    reach_px = math.ceil(float(points.radius_px.max())) if len(points.radius_px) else 0
    nearness = torch.where(surface_depth_m > 0, 1 / surface_depth_m, 0)  # 0 where there is none
    most, farthest_m = _most_around(torch.stack([nearness, surface_depth_m]), reach_px)
    slack = 1 + SURFACE_TOLERANCE / (1 - SURFACE_TOLERANCE) + 1e-4  # of rounding
    is_near = points.depth_m <= slack * _at(farthest_m, points)
    return is_near & (points.depth_m * _at(most, points) * slack >= 1)


DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
"""The 8 directions around a pixel, as steps in (rows, columns)."""


def curtain(surface: Float[Tensor, "height width"], reach_px: int) -> Float[Tensor, "height width"]:
    """The depth beyond which each of the 8 directions meets nearer surface.

    A direction is a wedge, not a ray: beyond its first pixel it is three pixels wide, so that it
    does not slip between the points of a sparse surface.
    """
    height_px, width_px = surface.shape
    wide = -torch.nn.functional.max_pool2d(-surface[None], 3, 1, 1)[0]
    narrow = torch.nn.functional.pad(surface, [reach_px] * 4, value=torch.inf)
    wide = torch.nn.functional.pad(wide, [reach_px] * 4, value=torch.inf)
    behind = torch.zeros_like(surface)
    for step_v, step_u in DIRECTIONS:
        best = torch.full_like(surface, torch.inf)
        for step in range(1, reach_px + 1):
            top, left = reach_px + step * step_v, reach_px + step * step_u
            layer = narrow if step == 1 else wide
            torch.minimum(best, layer[top : top + height_px, left : left + width_px], out=best)
        torch.maximum(behind, best, out=behind)
    return behind


def surface_gaps(
    depth_m: Float[Tensor, "height width"], reach_px: int
) -> Bool[Tensor, "height width"]:
    """Pixels without depth that one surface surrounds.

    In `GAP_DIRECTIONS` a pixel with depth is met within reach, and all depths met differ by at most
    `GAP_DEPTH_RANGE`.
    """
    row, column = ((depth_m == 0) & spread(depth_m > 0, reach_px)).nonzero().unbind(-1)
    padded = torch.nn.functional.pad(depth_m, [reach_px] * 4).reshape(-1)
    row_px = depth_m.shape[1] + 2 * reach_px
    place = (row + reach_px) * row_px + column + reach_px
    met = []
    for step_v, step_u in DIRECTIONS:
        first = torch.zeros_like(depth_m[row, column])
        for step in range(reach_px, 0, -1):
            here = padded[place + step * (step_v * row_px + step_u)]
            first = torch.where(here > 0, here, first)
        met.append(first)
    ascending = torch.stack(met).sort(dim=0).values
    near, far = ascending[len(DIRECTIONS) - GAP_DIRECTIONS], ascending[-1]
    gaps = torch.zeros_like(depth_m, dtype=torch.bool)
    gaps[row, column] = (near > 0) & (far <= near * (1 + GAP_DEPTH_RANGE))
    return gaps


def spread(mask: Bool[Tensor, "height width"], reach_px: int) -> Bool[Tensor, "height width"]:
    """Pixels with a marked one in the square around them."""
    return _most_around(mask.float()[None], reach_px)[0] > 0


def _most_around(
    images: Float[Tensor, "images height width"], reach_px: int
) -> Float[Tensor, "images height width"]:
    """The largest value in the square around each pixel."""
    pool, side_px = torch.nn.functional.max_pool2d, 2 * reach_px + 1
    return pool(pool(images, (1, side_px), 1, (0, reach_px)), (side_px, 1), 1, (reach_px, 0))
