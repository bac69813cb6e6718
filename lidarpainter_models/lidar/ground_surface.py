"""The ground as a fine height field, from LiDAR points: what a simulator drives on.

World frame, z up, metres. Which points are ground is found on a coarse grid by the simple
morphological filter of Pingel et al. (2013): what rises from the lowest returns faster than a
street does, over windows that grow up to the size of a lorry, stands on the ground. The fine grid
holds the median of the points in each cell that lie on that ground, interpolated over holes as
wide as the LiDAR leaves between its rings, and under the recording car, which hides the road that
it drives on.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.interpolate import griddata
from scipy.spatial import cKDTree

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.lidar.lidar_map import MapPoints

CELL_M = 0.15
"""A finer cell holds too few points, a coarser one rounds kerbs off."""
COARSE_CELL_M = 0.6
"""The cells in which the lowest returns are looked for: few hold nothing but a car."""
LOW_QUANTILE = 0.1
"""Of the heights in a coarse cell: some returns come from below the road, out of puddles."""
MOST_SLOPE = 0.2
"""A street rises by less; what rises faster stands on it. Kerbs are lower than `STEP_M`."""
STEP_M = 0.2
WINDOWS = (1, 2, 3, 4, 6, 8, 11, 14)
"""Half widths of the windows, in coarse cells: the last one is wider than any lorry is long."""
NEAR_GROUND_M = 0.15
"""Points so near to the coarse ground are ground; its own cells smear slopes and kerbs by less."""
REACH_M = 50.0
"""Ground farther from the path is left out: nobody drives there, and few points lie on it."""
HOLE_M, HOLE_PER_M = 1.5, 0.05
"""A hole is closed where the ground around it is so far apart at most, and so much farther for each
metre from the path: less than a car is wide, and than rings of a LiDAR with 64 beams part."""
STEEP_M = 0.35
"""Where the lowest returns part by more within two coarse cells there is a wall, not a kerb on a
slope: what lies behind it is no ground unless the street leads there."""
OWN_HALF_WIDTH_M, OWN_HALF_LENGTH_M = 2.0, 5.0
"""Around the path the ground is closed whatever the size of the hole: the car stood on it."""
LEAST_POINTS = 100
MOST_CELLS = 40_000_000
"""Of the fine grid: a drive of several kilometres, two gigabytes while it is made."""


@dataclass(frozen=True, eq=False, kw_only=True)
class GroundSurface:
    """Heights at the corners of square cells, NaN where the ground is not known."""

    height_m: Float[np.ndarray, "columns rows"]
    """World z; columns go along x, rows along y."""
    origin_m: tuple[float, float]
    """World x and y of the first height."""
    cell_m: float = CELL_M

    def at(self, xy_m: Float[np.ndarray, "*places 2"]) -> Float[np.ndarray, "*places"]:
        """Ground z at places of the world, on the triangles of `mesh`; NaN where it has a hole."""
        place = (np.asarray(xy_m, float) - self.origin_m) / self.cell_m
        last = np.array(self.height_m.shape) - 2
        corner = np.clip(np.floor(np.nan_to_num(place)), 0, last).astype(int)
        along, across = np.moveaxis(place - corner, -1, 0)
        i, j = np.moveaxis(corner, -1, 0)
        z = self.height_m
        # each cell is cut from its first corner to the opposite one
        upper = z[i, j] + across * (z[i, j + 1] - z[i, j]) + along * (z[i + 1, j + 1] - z[i, j + 1])
        lower = z[i, j] + along * (z[i + 1, j] - z[i, j]) + across * (z[i + 1, j + 1] - z[i + 1, j])
        found = np.where(along > across, lower, upper)
        is_outside = (np.minimum(along, across) < 0) | (np.maximum(along, across) > 1)
        return np.where(is_outside, np.nan, found)

    def everywhere(self) -> "GroundSurface":
        """The same with every unknown height as that of the nearest known one."""
        return replace(self, height_m=_nearest_filled(self.height_m))

    def mesh(self) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
        """Vertices (world, float32) and triangles, counter-clockwise from above."""
        known = np.isfinite(self.height_m)
        first, right = known[:-1, :-1], known[1:, :-1]
        up, opposite = known[:-1, 1:], known[1:, 1:]
        numbers = np.arange(known.size).reshape(known.shape)
        corners = [numbers[:-1, :-1], numbers[1:, :-1], numbers[1:, 1:], numbers[:-1, 1:]]
        a, b, c, d = corners
        lower, upper = first & right & opposite, first & opposite & up
        faces = np.concatenate(
            [
                np.stack([a[lower], b[lower], c[lower]], axis=1),
                np.stack([a[upper], c[upper], d[upper]], axis=1),
            ]
        )
        used, faces = np.unique(faces, return_inverse=True)
        column, row = np.divmod(used, known.shape[1])
        x, y = (np.stack([column, row]) * self.cell_m) + np.array(self.origin_m)[:, None]
        vertices = np.stack([x, y, self.height_m.ravel()[used]], axis=1).astype(np.float32)
        return vertices, faces.reshape(-1, 3).astype(np.int32)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Grid:
    """Square cells over a part of the world."""

    low_m: Float[np.ndarray, "2"]
    """World x and y of the first corner."""
    cell_m: float
    shape: tuple[int, int]

    @classmethod
    def over(
        cls, low_m: Float[np.ndarray, "2"], high_m: Float[np.ndarray, "2"], cell_m: float
    ) -> "_Grid":
        """The grid that reaches from one corner of the world to another."""
        columns, rows = (np.ceil((high_m - low_m) / cell_m).astype(int) + 1).tolist()
        return cls(low_m=low_m, cell_m=cell_m, shape=(columns, rows))

    def nearest(
        self, xy_m: Float[np.ndarray, "places 2"]
    ) -> tuple[Int[np.ndarray, " places"], ...]:
        """Columns and rows of the corners nearest to some places."""
        column, row = np.rint((xy_m - self.low_m) / self.cell_m).astype(int).T
        return column, row

    def quantiles(
        self, xyz_m: Float[np.ndarray, "points 3"], quantile: float
    ) -> Float[np.ndarray, "columns rows"]:
        """A quantile of the heights of the points around each corner, NaN where there is none."""
        cells = np.ravel_multi_index(self.nearest(xyz_m[:, :2]), self.shape)
        order = np.lexsort((xyz_m[:, 2], cells))
        known, starts, counts = np.unique(cells[order], return_index=True, return_counts=True)
        heights = np.full(self.shape, np.nan)
        heights.ravel()[known] = xyz_m[order[starts + (quantile * (counts - 1)).astype(int)], 2]
        return heights


def ground_surface(points: MapPoints, path: DrivenPath) -> GroundSurface:
    """Build the ground around a path from points of the street.

    Args:
        points: of the street, in the world; with what stands on the ground.
        path: where the recording car drove.

    Raises:
        SceneError: no point lies near the path, or the path is longer than a grid can hold.
    """
    path_m = path.world_from_body[:, :2, 3].numpy()
    low_m, high_m = path_m.min(axis=0) - REACH_M, path_m.max(axis=0) + REACH_M
    grid = _Grid.over(low_m, high_m, CELL_M)
    if grid.shape[0] * grid.shape[1] > MOST_CELLS:
        raise SceneError(
            f"the ground of a drive over {high_m[0] - low_m[0]:.0f} x {high_m[1] - low_m[1]:.0f} m "
            f"needs more than {MOST_CELLS} cells: take fewer frames"
        )
    xyz_m = points.xyz_m.numpy().astype(float)
    xyz_m = xyz_m[((xyz_m[:, :2] > low_m) & (xyz_m[:, :2] < high_m)).all(axis=1)]
    if len(xyz_m) < LEAST_POINTS:
        raise SceneError(
            f"{len(xyz_m)} LiDAR points within {REACH_M:g} m of the path, expected {LEAST_POINTS} "
            "to know the ground by"
        )
    coarse_m = _coarse_ground(xyz_m, _Grid.over(low_m, high_m, COARSE_CELL_M), path_m)
    is_ground = np.abs(xyz_m[:, 2] - coarse_m) < NEAR_GROUND_M
    heights = _closed(grid.quantiles(xyz_m[is_ground], 0.5), path, grid)
    is_driven = _reached(np.isfinite(heights), grid.nearest(path_m))
    heights = np.where(is_driven, heights, np.nan)
    return GroundSurface(height_m=heights, origin_m=(low_m[0], low_m[1]))


def _coarse_ground(
    xyz_m: Float[np.ndarray, "points 3"], grid: _Grid, path_m: Float[np.ndarray, "poses 2"]
) -> Float[np.ndarray, " points"]:
    """Height of the ground under every point, roughly, without what stands on it."""
    lowest = grid.quantiles(xyz_m, LOW_QUANTILE)
    surface = known = _nearest_filled(lowest)
    stands = np.isnan(lowest)
    for half in WINDOWS:
        opened = ndimage.grey_opening(surface, size=(2 * half + 1, 2 * half + 1))
        stands |= surface - opened > STEP_M + MOST_SLOPE * half * COARSE_CELL_M
        surface = opened
    ground = _nearest_filled(np.where(stands, np.nan, known))
    parts = ndimage.maximum_filter(ground, size=3) - ndimage.minimum_filter(ground, size=3)
    is_street = _reached(parts < STEEP_M, grid.nearest(path_m))
    if is_street.any():
        ground = _nearest_filled(np.where(is_street & ~stands, ground, np.nan))
    at = ((xyz_m[:, :2] - grid.low_m) / grid.cell_m).T
    return ndimage.map_coordinates(ground, at, order=1, mode="nearest")


def _reached(
    is_passable: Bool[np.ndarray, "columns rows"], driven: tuple[Int[np.ndarray, " poses"], ...]
) -> Bool[np.ndarray, "columns rows"]:
    """Corners to which a passable way leads from those that were driven on."""
    parts, _ = ndimage.label(is_passable)
    reached = np.unique(parts[driven])
    return np.isin(parts, reached[reached > 0])


def _nearest_filled(grid: Float[np.ndarray, "columns rows"]) -> Float[np.ndarray, "columns rows"]:
    """The grid with every unknown cell as the known one nearest to it."""
    nearest = ndimage.distance_transform_edt(
        np.isnan(grid), return_distances=False, return_indices=True
    )
    return grid[tuple(nearest)]


def _closed(
    heights: Float[np.ndarray, "columns rows"], path: DrivenPath, grid: _Grid
) -> Float[np.ndarray, "columns rows"]:
    """Interpolate over holes that are narrow enough, and under the recording car."""
    is_hole = np.isnan(heights)
    gap_m = 2 * grid.cell_m * ndimage.distance_transform_edt(is_hole)[is_hole]
    holes = np.argwhere(is_hole)
    from_path_m, is_own = _beside_path(holes * grid.cell_m + grid.low_m, path)
    wanted = holes[(gap_m <= HOLE_M + HOLE_PER_M * from_path_m) | is_own]
    if not len(wanted):
        return heights
    border = ~is_hole & ndimage.binary_dilation(is_hole, iterations=2)
    filled = heights.copy()
    filled[tuple(wanted.T)] = griddata(np.argwhere(border), heights[border], wanted)
    return filled


def _beside_path(
    xy_m: Float[np.ndarray, "places 2"], path: DrivenPath
) -> tuple[Float[np.ndarray, " places"], Bool[np.ndarray, " places"]]:
    """How far places are from the path, and which the recording car stood on or hid."""
    path_m = path.world_from_body[:, :2, 3].numpy()
    from_path_m, nearest = cKDTree(path_m).query(xy_m)
    offset, ahead = xy_m - path_m[nearest], path.directions.numpy()[nearest, :2]
    along = np.abs((offset * ahead).sum(axis=1))
    across = np.abs(offset[:, 1] * ahead[:, 0] - offset[:, 0] * ahead[:, 1])
    return from_path_m, (along < OWN_HALF_LENGTH_M) & (across < OWN_HALF_WIDTH_M)
