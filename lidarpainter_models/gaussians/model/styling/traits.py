"""What Gaussians are as surfaces: which way they face, whether they are road or a lit window.

Ground is what rain wets and beams graze, by cells of the street's Gaussians; a wet road mirrors the
skylines that stand around places all over it.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, axes_at
from lidarpainter_models.gaussians.model.styling.scene_style import StyledPlace
from lidarpainter_models.kernels.frustum_culling import MOST_SIGMAS
from lidarpainter_models.kernels.scene_light import Surfaces, body_radii
from lidarpainter_models.weather.darkness import FACING, HEADLAMP_HEIGHT_M, LEAST_GRAZING
from lidarpainter_models.weather.light import to_linear

CELL_M = 1.0
LOW_SHARE = 0.2
"""The ground of a cell lies where so many of its Gaussians are below."""
GROUND_HEIGHT_M = 0.25
"""Surfaces up to this height are ground."""
TOLERANCE_M, RISE = 0.6, 0.08
"""How far ground may be off the road's level, beside it and per metre away."""
LEAST_OPACITY = 0.3
MOST_CELLS = 4_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """Heights of the ground in level cells."""

    corner: Float[Tensor, "2"]
    height_m: Float[Tensor, "rows columns"]
    """World z; infinitely deep where there is no ground."""

    def cells(self, points_world: Float[Tensor, "points 3"]) -> Int[Tensor, " points"]:
        """The cell over or under each point, the nearest if it lies beside all."""
        rows, columns = self.height_m.shape
        place = ((points_world[:, :2] - self.corner) / CELL_M).floor().long()
        return place[:, 0].clamp(0, rows - 1) * columns + place[:, 1].clamp(0, columns - 1)

    def share(self, points_world: Float[Tensor, "points 3"]) -> Float[Tensor, " points"]:
        """How far each point counts as ground: 1 on it, 0 from `GROUND_HEIGHT_M` on."""
        above = points_world[:, 2] - self.height_m.flatten()[self.cells(points_world)]
        return (2 - 2 * above.abs() / GROUND_HEIGHT_M).clamp(0, 1)


def find_ground(
    points_world: Float[Tensor, "points 3"],
    opacity: Float[Tensor, " points"],
    road: Float[Tensor, "frames 3"],
) -> Ground:
    """The low surfaces that continue the road.

    `points_world` are centres of the street's Gaussians, `road` points of the road that was driven.
    """
    margin_m = 80.0
    low, high = road[:, :2].amin(dim=0) - margin_m, road[:, :2].amax(dim=0) + margin_m
    rows, columns = (max(int(size), 1) for size in ((high - low) / CELL_M).ceil())
    if rows * columns > MOST_CELLS:  # a long drive: what lies beside all of it is left out
        high = low + (high - low) * (MOST_CELLS / (rows * columns)) ** 0.5
        rows, columns = (max(int(size), 1) for size in ((high - low) / CELL_M).ceil())
    deep = points_world.new_full((rows * columns,), -torch.inf)
    ground = Ground(corner=low, height_m=deep.reshape(rows, columns))
    is_inside = ((points_world[:, :2] >= low) & (points_world[:, :2] < high)).all(dim=1)
    points = points_world[is_inside & (opacity > LEAST_OPACITY)]
    if not len(points):
        return ground
    occupied, counts, heights = _low_heights(ground.cells(points), points[:, 2])
    is_level = _continues_road(occupied, heights, ground, road) & (counts > 1)
    deep[occupied[is_level]] = heights[is_level]
    return ground


def _low_heights(
    cells: Int[Tensor, " points"], z: Float[Tensor, " points"]
) -> tuple[Int[Tensor, " cells"], Int[Tensor, " cells"], Float[Tensor, " cells"]]:
    """Occupied cells, how many points each holds, and a low height of them."""
    by_height = torch.argsort(z)
    by_cell = torch.argsort(cells[by_height], stable=True)
    order = by_height[by_cell]
    occupied, counts = torch.unique_consecutive(cells[order], return_counts=True)
    first = counts.cumsum(0) - counts
    return occupied, counts, z[order[first + (LOW_SHARE * counts).long()]]


def _continues_road(
    cells: Int[Tensor, " cells"],
    heights: Float[Tensor, " cells"],
    ground: Ground,
    road: Float[Tensor, "frames 3"],
) -> Bool[Tensor, " cells"]:
    """Whether the low surface of a cell is about as high as the nearest road."""
    columns = ground.height_m.shape[1]
    xy = torch.stack([cells // columns, cells % columns], dim=1).to(heights) + 0.5
    away = torch.cdist(xy * CELL_M + ground.corner, road[:, :2].to(heights))
    nearest_m, frame = away.min(dim=1)
    off_m = (heights - road[frame, 2].to(heights)).abs()
    return off_m < TOLERANCE_M + RISE * nearest_m


SPACING_M = 6.0
SECTORS = 24
FARTHEST_M = 80.0
NEAREST_M = 1.0
MOST_OBSTACLES = 20_000
HIGH_SHARE = 0.9
"""A sector is as high as this share of what stands in it."""
CHUNK = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class Skylines:
    """What stands around places, by equal sectors of azimuth from x towards y."""

    of_surface: Int[Tensor, " gaussians"]
    """The place next to each wet surface; -1 for what is not wet."""
    day_light: Float[Tensor, "places sectors 3"]
    """Mean daylight of what stands there."""
    slope: Float[Tensor, "places sectors"]
    """Tangent of its height; 0 under open sky."""


def find_skylines(
    points_world: Float[Tensor, "gaussians 3"],
    day_light: Float[Tensor, "gaussians 3"],
    wet: Float[Tensor, " gaussians"],
    is_obstacle: Float[Tensor, " gaussians"],
) -> Skylines:
    """Skylines of the places where the ground is wet.

    `day_light` is linear; `wet` is above 0 on the ground, `is_obstacle` for what stands on it.
    """
    rows = (wet > 0).nonzero()[:, 0]
    place = (points_world[rows, :2] / SPACING_M).round()
    places, of_row = torch.unique(place, dim=0, return_inverse=True)
    of_surface = points_world.new_full((len(points_world),), -1, dtype=torch.int32)
    of_surface[rows] = of_row.int()
    level = points_world.new_zeros(len(places)).index_add(0, of_row, points_world[rows, 2])
    level = level / torch.bincount(of_row, minlength=len(places)).clamp_min(1)
    obstacles = (is_obstacle > 0).nonzero()[:, 0]
    obstacles = obstacles[:: max(1, math.ceil(len(obstacles) / MOST_OBSTACLES))]
    found = [
        _around(part, points_world[obstacles], day_light[obstacles])
        for part in torch.cat([places * SPACING_M, level[:, None]], dim=1).split(CHUNK)
    ]
    nothing = points_world.new_zeros(0, SECTORS, 4)
    table = torch.cat([nothing, *found])
    return Skylines(of_surface=of_surface, day_light=table[..., :3], slope=table[..., 3])


def _around(
    places: Float[Tensor, "places 3"],
    obstacles: Float[Tensor, "obstacles 3"],
    light: Float[Tensor, "obstacles 3"],
) -> Float[Tensor, "places sectors 4"]:
    """Mean light and height of what stands in each sector."""
    offset = obstacles - places[:, None]
    away_m = offset[..., :2].norm(dim=-1)
    slope = offset[..., 2] / away_m.clamp_min(NEAREST_M)
    counts = ((away_m > NEAREST_M) & (away_m < FARTHEST_M) & (slope > 0)).float()
    weight = counts / away_m.clamp_min(NEAREST_M)  # what is near hides what is behind it
    turn = torch.remainder(torch.atan2(offset[..., 1], offset[..., 0]) / (2 * math.pi), 1)
    sector = (turn * SECTORS).round().long() % SECTORS
    slots = sector + SECTORS * torch.arange(len(places), device=places.device)[:, None]
    total = places.new_zeros(len(places) * SECTORS).index_add(0, slots.flatten(), weight.flatten())
    summed = places.new_zeros(len(places) * SECTORS, 3).index_add(
        0, slots.flatten(), (weight[..., None] * light).flatten(0, 1)
    )
    highest = places.new_zeros(len(places) * SECTORS).scatter_reduce(
        0, slots.flatten(), (slope * counts).flatten(), "amax"
    )
    mean = summed / total.clamp_min(1e-6)[:, None]
    return torch.cat([mean, HIGH_SHARE * highest[:, None]], dim=1).reshape(-1, SECTORS, 4)


WINDOW_DEPTH_M = 0.6
"""A Gaussian belongs to a window's pane up to this distance before and behind it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceTraits:
    """Facts about the Gaussians of a scene that no style and no time changes."""

    surfaces: Surfaces
    day_light: Float[Tensor, "gaussians 3"]
    """Linear colour on a clear day, without what depends on the direction of view."""
    base_rgb: Float[Tensor, "gaussians 3"]
    ground: Float[Tensor, " gaussians"]
    """How far each is ground, in [0, 1]."""
    window: Float[Tensor, " gaussians"]
    """How far each is a lit window, in [0, 1]."""
    skylines: Skylines


def surface_traits(gaussians: GaussianSet, place: StyledPlace) -> SurfaceTraits:
    """Find them; the street's Gaussians may be ground and windows, those of actors neither."""
    columns = gaussians.columns()
    means, body = columns["means"], columns["body_index"]
    street = (body == 0).float()
    opacity = columns["opacity_logit"].sigmoid()
    road = place.ego_lamp - place.ego_lamp.new_tensor([0.0, 0.0, HEADLAMP_HEIGHT_M])
    ground = find_ground(means, opacity * street, road).share(means) * street
    base_rgb = gaussians.base_rgb.detach()
    day_light = to_linear(base_rgb)
    scale_m = columns["log_scale"].exp()
    up = means.new_tensor([0.0, 0.0, 1.0])
    normals = ground[:, None] * up + (1 - ground)[:, None] * _normals(columns, scale_m)
    facing = FACING + ground * (1 - FACING)
    return SurfaceTraits(
        surfaces=Surfaces(
            means=means,
            body_index=body,
            reach_m=MOST_SIGMAS * scale_m.amax(dim=1),
            normals=normals,
            facing=facing,
            least_facing=facing * LEAST_GRAZING,
            body_radius_m=body_radii(means, body),
        ),
        day_light=day_light,
        base_rgb=base_rgb,
        ground=ground,
        window=_windows(means, place) * street,
        skylines=find_skylines(means, day_light, ground, street * (ground == 0) * (opacity > 0.5)),
    )


def _normals(
    columns: dict[str, Tensor], scale_m: Float[Tensor, "gaussians 3"]
) -> Float[Tensor, "gaussians 3"]:
    """The shortest axis of each Gaussian in its body, shorter the less flat it is."""
    shortest, middle, _ = scale_m.sort(dim=1).values.unbind(1)
    normals = axes_at(columns["rotation_wxyz"], scale_m.argmin(dim=1))
    return normals * (1 - shortest / middle.clamp_min(1e-9))[:, None]


def _windows(
    points_world: Float[Tensor, "gaussians 3"], place: StyledPlace
) -> Float[Tensor, " gaussians"]:
    """1 in the pane of a lit window, falling to 0 along its frame; one window at a time."""
    found = torch.zeros_like(points_world[:, 0])
    for centre, along, half_m in zip(
        place.window_centre, place.window_along, place.window_half_m, strict=True
    ):
        offset = points_world - centre
        sideways = offset @ along
        across = offset[:, 0] * along[1] - offset[:, 1] * along[0]
        edge = torch.minimum(half_m[0] - sideways.abs(), half_m[1] - offset[:, 2].abs())
        inside = (edge / 0.1 + 0.5).clamp(0, 1) * (across.abs() < WINDOW_DEPTH_M)
        found = torch.maximum(found, inside)
    return found
