"""How one view sees one box: which pixels, which side of it, and what stands before it.

Box frame: x along the length, y left, z up, origin at the centre; depth is camera z in metres. A
ray enters a box through one side, by slabs (Kay and Kajiya, 1986).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.box_masks import NEAR_M, box_outlines
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid

SIDES = ("rear", "front", "right", "left", "bottom", "top")
"""Sides by the axis that points out of them: -x, +x, -y, +y, -z, +z."""
BEFORE_M = 0.3
"""A surface so far before the box is another one: Gaussians of an actor reach out of its box."""


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
