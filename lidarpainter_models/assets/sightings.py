"""How well an actor was seen: from where, which sides of it, how sharp, how right, how hidden.

`box_view` sees one box in one view; `Sighting` collects views one by one, and its numbers stand in
the catalog. Directions are those from the middle of the box to the camera. Box frame: x along the
length, y left, z up, origin at the centre; depth is camera z in metres. A ray enters a box through
one side, by slabs (Kay and Kajiya, 1986).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.box_masks import NEAR_M, box_outlines
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.metrics.images import psnr_from_error

SIDES = ("rear", "front", "right", "left", "bottom", "top")
"""Sides by the axis that points out of them: -x, +x, -y, +y, -z, +z."""
BEFORE_M = 0.3
"""A surface so far before the box is another one: Gaussians of an actor reach out of its box."""
LEAST_PIXELS = 64
"""A view that shows less of a box says nothing about it."""
MOST_HIDDEN = 0.5
"""A view in which more of the box is hidden was not seen from there."""
CELLS = 4
"""A side is this many cells long and high."""
LEAST_SLOPE = 0.2
"""Sine of the least angle between a side and the way it is looked at: 12 degrees."""
SEEN_CELLS = 0.5
"""Share of a side's cells from which on it counts as seen."""
REACH_RAD = math.radians(20)
"""So far around the direction of a view an actor looks as it did there."""
NUM_DIRECTIONS = 1000
SIDE_WEIGHTS = {"front": 0.2, "rear": 0.2, "left": 0.25, "right": 0.25, "top": 0.1}
"""What a side counts for: long ones show most, and cameras of cars hardly see the top."""
WORST_DB, BEST_DB = 15.0, 30.0
"""From the PSNR of a smear in the right colour to that of a good fit of a recorded car."""
FINE_PIXELS_PER_M = 50.0
"""As a camera of 1920 px and 60 degrees shows what is 33 m away."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BoxView:
    """The pixels of a view whose rays meet a box."""

    row: Int[Tensor, " pixels"]
    column: Int[Tensor, " pixels"]
    side: Int[Tensor, " pixels"]
    """Where the ray enters: its place in `SIDES`."""
    entry_box: Float[Tensor, "pixels 3"]
    """Where it enters, in the box frame as shares of the half sides, -1 to 1."""
    is_hidden: Bool[Tensor, " pixels"]
    """Whether something stands before the box there."""
    camera_box: Float[Tensor, "3"]
    """Where the camera stands, in the box frame; metres."""

    @property
    def hidden_share(self) -> float:
        """Share of its pixels before which something stands."""
        return float(self.is_hidden.float().mean())


def box_view(
    camera: Camera,
    depth_m: Float[Tensor, "height width"],
    world_from_box: Float[Tensor, "4 4"],
    size_m: Float[Tensor, "3"],
) -> BoxView | None:
    """See a box in a view whose surfaces are known; None where no pixel meets it.

    Args:
        camera: of the view.
        depth_m: of what is seen, 0 where that is the sky.
        world_from_box: pose of the box.
        size_m: length, width, height.
    """
    outlines = box_outlines(camera, world_from_box[None], size_m[None])
    if not outlines:
        return None
    corners_uv = torch.from_numpy(outlines[0].pixels_uv)
    limit = torch.tensor([camera.width_px, camera.height_px]).double()
    low = corners_uv.amin(0).floor().clamp(min=0).minimum(limit).long()
    high = corners_uv.amax(0).ceil().clamp(min=0).minimum(limit).long()
    if not bool((high > low).all()):
        return None
    column = torch.arange(int(low[0]), int(high[0]))
    row = torch.arange(int(low[1]), int(high[1]))
    grid_row, grid_column = (one.flatten() for one in torch.meshgrid(row, column, indexing="ij"))
    ray_camera = torch.stack(
        [
            (grid_column + 0.5 - camera.cx_px) / camera.fx_px,
            (grid_row + 0.5 - camera.cy_px) / camera.fy_px,
            torch.ones(len(grid_row)),
        ],
        dim=1,
    ).double()
    half_m = size_m.double() / 2
    box_from_camera = invert_rigid(world_from_box.double()) @ camera.world_from_camera.double()
    origin, ray = box_from_camera[:3, 3], ray_camera @ box_from_camera[:3, :3].T
    safe = torch.where(ray.abs() < 1e-12, torch.full_like(ray, 1e-12), ray)
    near_m = (-half_m * safe.sign() - origin) / safe  # of the side that a ray meets first
    far_m = (half_m * safe.sign() - origin) / safe
    entry_m, axis = near_m.max(dim=1)
    kept = ((entry_m <= far_m.amin(1)) & (entry_m >= NEAR_M)).nonzero()[:, 0]
    if not len(kept):
        return None
    axis, entry_m = axis[kept], entry_m[kept]
    is_positive = safe[kept, axis] < 0  # the ray goes down the axis: it enters at its upper end
    row, column = grid_row[kept], grid_column[kept]
    surface_m = depth_m[row, column].double()
    return BoxView(
        row=row,
        column=column,
        side=2 * axis + is_positive.long(),
        entry_box=((origin + entry_m[:, None] * ray[kept]) / half_m).float(),
        is_hidden=(surface_m > 0) & (surface_m < entry_m - BEFORE_M),
        camera_box=origin,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """One view of an actor."""

    azimuth_deg: float
    """0 ahead of it, 90 to its left."""
    elevation_deg: float
    distance_m: float
    num_pixels: int
    hidden_share: float


@dataclass(kw_only=True, eq=False)
class Sighting:
    """What the views of one run show of one actor."""

    looks: list[Look] = field(default_factory=list)
    cells: Bool[Tensor, "6 cells cells"] = field(
        default_factory=lambda: torch.zeros(len(SIDES), CELLS, CELLS, dtype=torch.bool)
    )
    """Which parts of its sides were seen, at a slope that shows something."""
    pixels_per_m: float = 0.0
    squared_error: float = 0.0
    num_judged: int = 0
    """Pixels that the error is a sum over."""
    gradient: float = 0.0
    """Gradients of the rendered images inside the box, summed."""
    true_gradient: float = 0.0
    """Gradients of the recorded images there, summed."""

    def add_look(self, seen: BoxView, focal_px: float) -> None:
        """Take a view, if it shows enough to say something."""
        if len(seen.row) < LEAST_PIXELS:
            return
        x, y, z = seen.camera_box.tolist()
        distance_m = math.hypot(x, y, z)
        self.looks.append(
            Look(
                azimuth_deg=round(math.degrees(math.atan2(y, x)), 1),
                elevation_deg=round(math.degrees(math.asin(z / distance_m)), 1),
                distance_m=round(distance_m, 2),
                num_pixels=len(seen.row),
                hidden_share=round(seen.hidden_share, 4),
            )
        )
        shown = ~seen.is_hidden
        if seen.hidden_share <= MOST_HIDDEN:
            self.pixels_per_m = max(self.pixels_per_m, focal_px / distance_m)
        for side in seen.side[shown].unique().tolist():
            axis = side // 2
            if abs(float(seen.camera_box[axis])) / distance_m < LEAST_SLOPE:
                continue
            across, along = (other for other in range(3) if other != axis)
            here = shown & (seen.side == side)
            cell = ((seen.entry_box[here] + 1) / 2 * CELLS).long().clamp(0, CELLS - 1)
            self.cells[side, cell[:, across], cell[:, along]] = True

    def add_error(
        self,
        seen: BoxView,
        squared_error: Float[Tensor, "height width"],
        gradient: Float[Tensor, "height width"],
        true_gradient: Float[Tensor, "height width"],
    ) -> None:
        """Hold a view against the image that was recorded, where nothing stands before the box."""
        row, column = seen.row[~seen.is_hidden], seen.column[~seen.is_hidden]
        self.squared_error += float(squared_error[row, column].double().sum())
        self.gradient += float(gradient[row, column].double().sum())
        self.true_gradient += float(true_gradient[row, column].double().sum())
        self.num_judged += len(row)

    @classmethod
    def of_all(cls, sightings: Sequence["Sighting"]) -> "Sighting":
        """What several runs show of one actor together."""
        return cls(
            looks=[look for one in sightings for look in one.looks],
            cells=torch.stack([one.cells for one in sightings]).any(dim=0),
            pixels_per_m=max(one.pixels_per_m for one in sightings),
            squared_error=sum(one.squared_error for one in sightings),
            num_judged=sum(one.num_judged for one in sightings),
            gradient=sum(one.gradient for one in sightings),
            true_gradient=sum(one.true_gradient for one in sightings),
        )

    @property
    def near_looks(self) -> list[Look]:
        """Those that show most of it."""
        return [look for look in self.looks if look.hidden_share <= MOST_HIDDEN]

    @property
    def sides(self) -> list[str]:
        """The sides that were seen, of those that can be."""
        shares = self.cells.float().mean(dim=(1, 2)).tolist()
        seen = {name for name, share in zip(SIDES, shares, strict=True) if share >= SEEN_CELLS}
        return [name for name in SIDE_WEIGHTS if name in seen]

    @property
    def coverage(self) -> float:
        """Share of the directions above the horizon that lie near one it was seen from."""
        directions = half_sphere(NUM_DIRECTIONS)
        looks = [
            (math.radians(look.azimuth_deg), math.radians(look.elevation_deg))
            for look in self.near_looks
        ]
        if not looks:
            return 0.0
        azimuth, elevation = torch.tensor(looks).unbind(1)
        flat = elevation.cos()
        from_where = torch.stack(
            [flat * azimuth.cos(), flat * azimuth.sin(), elevation.sin()], dim=1
        )
        nearest = (directions @ from_where.T).amax(1)
        return float((nearest >= math.cos(REACH_RAD)).float().mean())

    @property
    def occlusion(self) -> float:
        """Share of it that others hid, the mean of its views by their pixels."""
        total = sum(look.num_pixels for look in self.looks)
        hidden = sum(look.num_pixels * look.hidden_share for look in self.looks)
        return hidden / total if total else 1.0

    @property
    def psnr_db(self) -> float | None:
        """Inside the box, over all judged views; None where none was."""
        if not self.num_judged:
            return None
        return psnr_from_error(max(self.squared_error / self.num_judged, 1e-10))

    @property
    def sharpness(self) -> float | None:
        """Its gradients against those of the images, at most 1; None where none was judged."""
        if not self.true_gradient:
            return None
        return min(1.0, self.gradient / self.true_gradient)

    @property
    def score(self) -> float:
        """How usable it is: the geometric mean of sides, truth, detail and openness.

        A geometric mean, since what fails in one of them is not made good by the others. What was
        not judged (a style has no truth) is left out of the mean.
        """
        factors = [
            sum(SIDE_WEIGHTS[side] for side in self.sides),
            min(1.0, self.pixels_per_m / FINE_PIXELS_PER_M) * (self.sharpness or 1.0),
            1.0 - self.occlusion,
        ]
        if self.psnr_db is not None:
            factors.append(min(1.0, max(0.0, (self.psnr_db - WORST_DB) / (BEST_DB - WORST_DB))))
        return math.prod(factors) ** (1 / len(factors))


def half_sphere(count: int) -> Float[Tensor, "directions 3"]:
    """Directions spread evenly over the upper half of the sphere, along a golden spiral."""
    number = torch.arange(count).double()
    height = (number + 0.5) / count
    azimuth = number * math.pi * (3 - math.sqrt(5))
    flat = (1 - height**2).sqrt()
    return torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), height], dim=1).float()
