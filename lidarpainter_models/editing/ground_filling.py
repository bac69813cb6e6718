"""The road where somebody stood or drove: kept where it was seen, made anew where it was not.

It is looked at from straight above, on a grid along the actor's heading with cells longer than
wide: what was never seen is continued along the road first, as lane markings and kerbs run. What
is known of a cell, best first: LiDAR points coloured when the actor was away; the fitted road; else
a smooth continuation of its surroundings. World: z up; metres.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from lidarpainter_models.gaussians.model.drawing import draw_gaussians
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, sh_from_rgb
from lidarpainter_models.gaussians.model.sky import push_pull
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.kernels.box_owners import NO_BOX, box_owners
from lidarpainter_models.lidar.actor_separation import poses_at
from lidarpainter_models.lidar.ground_heights import GroundHeights
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.scenes.tracks import ActorTrack

CELL_M = (0.3, 0.15)
"""Along the heading and across it."""
MOST_CELLS = 1_000_000
SHADOW_M = 0.6
"""So far outside its box an actor darkens the road."""
AROUND_M = (6.0, 2.0)
"""Along and across: the surroundings that are continued."""
ROAD_M = 0.2  # what is so near to the ground is the road
OVER_M = 1000.0  # height of the eye: from there every ray goes straight down
COVERED = 0.6  # opacity from which the fitted road is one
DARKER = 0.06  # than LiDAR saw the road without its actor: then there is a shadow in it
SEEN_CONFIDENCE, CONTINUED_CONFIDENCE = 0.9, 0.5
FADING_M = 1.5
"""Distance over which the confidence in a continued surface falls to 1/e."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Filling:
    """New Gaussians of the street, and how far they can be trusted."""

    gaussians: GaussianSet
    confidence: Float[Tensor, " gaussians"]
    """1 is as good as fitted."""

    def added_to(self, scene: GaussianScene) -> GaussianScene:
        """The scene with what was filled in, as its last rows."""
        return scene.with_gaussians(scene.gaussians.append(self.gaussians))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Patch:
    """Cells around the way of one actor."""

    track: ActorTrack
    heading_rad: float
    origin_xy_m: Float[Tensor, "2"]
    """Corner behind and to the right."""
    cell_m: tuple[float, float]
    rows: int
    """Along."""
    columns: int
    """Across."""

    @classmethod
    def of(cls, track: ActorTrack) -> "_Patch":
        poses = track.world_from_box.double()
        forward = poses[:, :2, 0].sum(dim=0)
        heading = math.atan2(float(forward[1]), float(forward[0]))
        corners = torch.tensor([[1.0, 1], [1, -1], [-1, 1], [-1, -1]]).double() / 2
        corners = corners * (track.size_m[:2].double() + 2 * SHADOW_M)
        xy_m = torch.einsum("tij,cj->tci", poses[:, :2, :2], corners) + poses[:, None, :2, 3]
        turn = _turn(heading)
        along = xy_m.reshape(-1, 2) @ turn
        low, high = along.amin(0), along.amax(0)
        low, high = low - torch.tensor(AROUND_M), high + torch.tensor(AROUND_M)
        coarser = max(1.0, math.sqrt(float((high - low).prod()) / math.prod(CELL_M) / MOST_CELLS))
        cell_m = (CELL_M[0] * coarser, CELL_M[1] * coarser)
        rows, columns = (
            math.ceil(float(side_m) / one_m)
            for side_m, one_m in zip(high - low, cell_m, strict=True)
        )
        return cls(
            track=track,
            heading_rad=heading,
            origin_xy_m=turn @ low,
            cell_m=cell_m,
            rows=rows,
            columns=columns,
        )

    def centres_xy_m(self) -> Float[Tensor, "cells 2"]:
        """Middles of the cells, row by row."""
        grid = torch.cartesian_prod(torch.arange(self.rows), torch.arange(self.columns)).double()
        return (
            self.origin_xy_m
            + ((grid + 0.5) * torch.tensor(self.cell_m)) @ _turn(self.heading_rad).T
        )

    def cells_of(
        self, xy_m: Float[Tensor, "points 2"]
    ) -> tuple[Int[Tensor, " inside"], Int[Tensor, " inside"]]:
        """Which points lie in the patch, and in which cell each of them."""
        away = (xy_m.double() - self.origin_xy_m) @ _turn(self.heading_rad)
        row, column = (away / torch.tensor(self.cell_m)).floor().long().unbind(1)
        inside = (row >= 0) & (row < self.rows) & (column >= 0) & (column < self.columns)
        points = inside.nonzero()[:, 0]
        return points, row[points] * self.columns + column[points]

    def eye(self) -> Camera:
        """A camera far above whose pixels are the cells: image right is across to the right."""
        forward = torch.tensor([math.cos(self.heading_rad), math.sin(self.heading_rad), 0.0])
        right = torch.tensor([forward[1], -forward[0], 0.0])
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.stack([right, -forward, torch.tensor([0.0, 0, -1])], dim=1)
        middle = torch.tensor([self.rows, self.columns]) * torch.tensor(self.cell_m) / 2
        pose[:2, 3] = self.origin_xy_m + _turn(self.heading_rad) @ middle.double()
        pose[2, 3] = float(self.track.world_from_box[:, 2, 3].mean()) + OVER_M
        return Camera(
            world_from_camera=pose,
            fx_px=OVER_M / self.cell_m[1],
            fy_px=OVER_M / self.cell_m[0],
            cx_px=self.columns / 2,
            cy_px=self.rows / 2,
            width_px=self.columns,
            height_px=self.rows,
        )

    def image(self, values: Shaped[Tensor, "cells *channels"]) -> Tensor:
        """Cells as rows and columns."""
        return values.unflatten(0, (self.rows, self.columns))


def fill_ground(
    scene: GaussianScene, street: MapPoints, ground: GroundHeights, left: Sequence[ActorTrack]
) -> tuple[GaussianScene, Filling]:
    """Mend the road where actors were that have left.

    Returns:
        The scene without what was wrong about its road, and what takes its place.
    """
    known = [torch.zeros(0)]
    for track in left:
        scene, filling = _fill_one(scene, street, ground, track)
        known.append(filling.confidence)
        scene = filling.added_to(scene)
    confidence = torch.cat(known)
    num_own = len(scene.gaussians) - len(confidence)
    rows = torch.arange(len(scene.gaussians))
    own, added = (scene.gaussians.select(some) for some in (rows[:num_own], rows[num_own:]))
    return scene.with_gaussians(own), Filling(gaussians=added, confidence=confidence)


def _fill_one(
    scene: GaussianScene, street: MapPoints, ground: GroundHeights, track: ActorTrack
) -> tuple[GaussianScene, Filling]:
    patch = _Patch.of(track)
    xy_m = patch.centres_xy_m()
    coarse_z_m = ground.around(xy_m.float())
    under = _swept(xy_m, coarse_z_m, track)
    clean = _clean_points(patch, street, coarse_z_m, track)
    fitted_rgb, alpha = _from_above(scene, patch, ground)
    known_rgb, is_seen, z_m = _evidence(patch, clean, coarse_z_m)
    if track.is_moving:
        shaded = _is_shaded(patch, known_rgb, fitted_rgb, is_seen)
        wanted = under & ((alpha < COVERED) | shaded)
        believed = (alpha >= COVERED) & ~shaded
    else:
        wanted, believed = under, (alpha >= COVERED) & ~under
    rgb = torch.where(is_seen[:, None] & wanted[:, None], known_rgb, fitted_rgb)
    known = believed | (is_seen & wanted)
    rgb = push_pull(patch.image(rgb), patch.image(known.float())).flatten(0, 1)
    scene = _without_road(scene, patch, wanted, ground)
    cells = wanted.nonzero()[:, 0]
    confidence = torch.full((len(cells),), SEEN_CONFIDENCE)
    fade = _distance_m(patch, known)[cells] / FADING_M
    continued = CONTINUED_CONFIDENCE * torch.exp(-fade)
    confidence = torch.where(is_seen[cells], confidence, continued)
    discs = _discs(patch, xy_m[cells], z_m[cells], rgb[cells], scene.gaussians.sh_degree)
    return scene, Filling(gaussians=discs, confidence=confidence)


def _is_shaded(
    patch: _Patch,
    known_rgb: Float[Tensor, "cells 3"],
    fitted_rgb: Float[Tensor, "cells 3"],
    is_seen: Bool[Tensor, " cells"],
) -> Bool[Tensor, " cells"]:
    """Where the fitted road is darker than LiDAR saw it, over more than a stripe of paint."""
    darker = torch.where(is_seen, (known_rgb - fitted_rgb).mean(dim=1), 0.0)
    both = patch.image(torch.stack([darker, is_seen.float()], dim=1)).permute(2, 0, 1)[None]
    total, count = torch.nn.functional.avg_pool2d(both, 7, 1, 3)[0]
    return is_seen & (total / count.clamp(min=1e-3) > DARKER).flatten()


def _swept(
    xy_m: Float[Tensor, "cells 2"], z_m: Float[Tensor, " cells"], track: ActorTrack
) -> Bool[Tensor, " cells"]:
    """Which cells were under the actor or in its contact shadow at any time."""
    poses = track.world_from_box.double().clone()
    poses[:, 2, 3] = 0  # seen from above, height does not matter
    flat = torch.cat([xy_m, torch.zeros(len(xy_m), 1)], dim=1).float()
    size_m = track.size_m + torch.tensor([2 * SHADOW_M, 2 * SHADOW_M, 10.0])
    owners = box_owners(
        flat, invert_rigid(poses), size_m.expand(len(poses), 3), margin_m=0.0, floor_m=0.0
    )
    return (owners != NO_BOX) & ~z_m.isnan()


def _clean_points(
    patch: _Patch, street: MapPoints, z_m: Float[Tensor, " cells"], track: ActorTrack
) -> tuple[Int[Tensor, " points"], Float[Tensor, "points 3"], Float[Tensor, "points 4"]]:
    """Road points measured while the actor was away: cell, place, colour and whether it has one."""
    low, high = (f(patch.centres_xy_m(), 0).float() for f in (torch.amin, torch.amax))
    near = ((street.xyz_m[:, :2] >= low) & (street.xyz_m[:, :2] <= high)).all(1).nonzero()[:, 0]
    points, cells = patch.cells_of(street.xyz_m[near, :2])
    rows = near[points]
    is_road = (street.xyz_m[rows, 2] - z_m[cells]).abs() < ROAD_M
    rows, cells = rows[is_road], cells[is_road]
    poses = poses_at(track, street.timestamp_ns[rows])
    away = street.xyz_m[rows].double() - poses[:, :3, 3]
    xyz_box_m = torch.einsum("nij,ni->nj", poses[:, :3, :3], away)[:, :2]
    near_it = (xyz_box_m.abs() <= track.size_m[:2] / 2 + SHADOW_M).all(dim=1)
    coloured = street.has_colour[rows] & ~near_it
    rgb = street.rgb_u8[rows].float() / 255
    return cells, street.xyz_m[rows], torch.cat([rgb, coloured[:, None].float()], dim=1)


def _evidence(
    patch: _Patch,
    clean: tuple[Int[Tensor, " points"], Float[Tensor, "points 3"], Float[Tensor, "points 4"]],
    coarse_z_m: Float[Tensor, " cells"],
) -> tuple[Float[Tensor, "cells 3"], Bool[Tensor, " cells"], Float[Tensor, " cells"]]:
    """Mean colour of each cell's clean points, where there are any, and height of the ground."""
    cells, xyz_m, rgb_and_weight = clean
    count = patch.rows * patch.columns
    weight = rgb_and_weight[:, 3:]
    total = torch.zeros(count, 4).index_add(0, cells, rgb_and_weight * weight)
    height = torch.zeros(count, 2).index_add(
        0, cells, torch.stack([xyz_m[:, 2], torch.ones(len(cells))], dim=1)
    )
    is_seen = total[:, 3] > 0
    rgb = total[:, :3] / total[:, 3:].clamp(min=1)
    has_height = height[:, 1] > 0
    z_m = torch.where(has_height, height[:, 0] / height[:, 1].clamp(min=1), coarse_z_m)
    smooth = push_pull(
        patch.image(z_m[:, None].nan_to_num().expand(-1, 3)), patch.image(has_height.float())
    )
    return rgb, is_seen, smooth.flatten(0, 1)[:, 0]


def _from_above(
    scene: GaussianScene, patch: _Patch, ground: GroundHeights
) -> tuple[Float[Tensor, "cells 3"], Float[Tensor, " cells"]]:
    """Colour and opacity of the fitted road, without what stands on it."""
    road = scene.gaussians.select(_road_rows(scene.gaussians, patch, ground))
    road = replace(road, sh_rest=torch.zeros(len(road), 0, 3))
    eye = patch.eye()
    bodies = eye.camera_from_world[None].float()
    image = draw_gaussians(road, bodies, eye)
    alpha = image.alpha.flip(0, 1)  # the image shows the last row on top, and left on the left
    rgb = image.rgb.flip(0, 1) / alpha.clamp(min=1e-3)[..., None]
    return rgb.flatten(0, 1).clamp(0, 1), alpha.flatten()


def _road_rows(
    gaussians: GaussianSet, patch: _Patch, ground: GroundHeights
) -> Int[Tensor, " road"]:
    """Gaussians of the street that lie on the ground of a patch."""
    points, _ = patch.cells_of(gaussians.means[:, :2])
    rows = points[gaussians.body_index[points] == 0]
    means = gaussians.means[rows]
    height_m = means[:, 2] - ground.around(means[:, :2].contiguous())
    return rows[height_m.abs() < ROAD_M]


def _without_road(
    scene: GaussianScene, patch: _Patch, wanted: Bool[Tensor, " cells"], ground: GroundHeights
) -> GaussianScene:
    """The scene without the road in the cells that are made anew."""
    gaussians = scene.gaussians
    rows = _road_rows(gaussians, patch, ground)
    _, cells = patch.cells_of(gaussians.means[rows, :2])
    gone = torch.zeros(len(gaussians), dtype=torch.bool)
    gone[rows[wanted[cells]]] = True
    return scene.with_gaussians(gaussians.select((~gone).nonzero()[:, 0]))


def _distance_m(patch: _Patch, known: Bool[Tensor, " cells"]) -> Float[Tensor, " cells"]:
    """How far it is from each cell to the nearest one of which something is known."""
    from scipy.ndimage import distance_transform_edt

    if not bool(known.any()):
        return torch.full((len(known),), math.inf)
    distance = distance_transform_edt(~patch.image(known).numpy(), sampling=patch.cell_m)
    return torch.as_tensor(distance).float().flatten()


def _discs(
    patch: _Patch,
    xy_m: Float[Tensor, "cells 2"],
    z_m: Float[Tensor, " cells"],
    rgb: Float[Tensor, "cells 3"],
    sh_degree: int,
) -> GaussianSet:
    """Flat Gaussians that close a surface."""
    count = len(xy_m)
    scale_m = torch.tensor([0.6 * patch.cell_m[0], 0.6 * patch.cell_m[1], 0.008])
    half = patch.heading_rad / 2
    return GaussianSet(
        means=torch.cat([xy_m.float(), z_m[:, None]], dim=1),
        rotation_wxyz=torch.tensor([math.cos(half), 0, 0, math.sin(half)]).repeat(count, 1),
        log_scale=scale_m.log().repeat(count, 1),
        opacity_logit=torch.full((count,), 0.95).logit(),
        sh_dc=sh_from_rgb(rgb),
        sh_rest=torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
        body_index=torch.zeros(count, dtype=torch.int32),
    )


def _turn(heading_rad: float) -> Float[Tensor, "2 2"]:
    """`world_from_patch`: along the heading, left of it."""
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    return torch.tensor([[cosine, -sine], [sine, cosine]], dtype=torch.float64)
