"""How recorded cameras move while their images are read, and in which order these are.

The motion of a camera is that of its own recorded poses, before and after each image.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.geometry.cameras import Shutter
from lidarpainter_models.geometry.transforms import invert_rigid, quaternion_from_rotation

_ACROSS = {"down": (0.0, 1.0), "up": (0.0, -1.0), "right": (1.0, 0.0), "left": (-1.0, 0.0)}


def recorded_shutters(
    rows: Sequence[Mapping[str, Any]], world_from_camera: Float[Tensor, "rows 4 4"]
) -> list[Shutter]:
    """The shutter of every row of the table of images: how it reads, as far as that is told."""
    shutters = {}
    for name in {row["camera"] for row in rows}:
        of_camera = [index for index, row in enumerate(rows) if row["camera"] == name]
        of_camera.sort(key=lambda index: int(rows[index]["timestamp_ns"]))
        times_ns = torch.tensor([rows[index]["timestamp_ns"] for index in of_camera])
        moving = twists_per_s(times_ns, world_from_camera[of_camera])
        for index, twist_per_s in zip(of_camera, moving, strict=True):
            columns, lines = _ACROSS[rows[index]["rolling_shutter_direction"] or "down"]
            duration_s = rows[index]["rolling_shutter_s"] or 0.0
            across_s = (columns * duration_s, lines * duration_s)
            shutters[index] = Shutter(across_s=across_s, twist_per_s=twist_per_s)
    return [shutters[index] for index in range(len(rows))]


def twists_per_s(
    timestamps_ns: Int[Tensor, " times"], world_from_camera: Float[Tensor, "times 4 4"]
) -> Float[Tensor, "times 6"]:
    """Turn (rad/s) and velocity (m/s) of a camera in its own frame, from its neighbours in time.

    Times ascend. A single pose does not move.
    """
    last = len(timestamps_ns) - 1
    places = torch.arange(last + 1)
    before, after = (places - 1).clamp(min=0), (places + 1).clamp(max=last)
    span_s = ((timestamps_ns[after] - timestamps_ns[before]).double() * 1e-9).clamp(min=1e-6)
    turn = invert_rigid(world_from_camera[before]) @ world_from_camera[after]
    wxyz = quaternion_from_rotation(turn[:, :3, :3])
    turned = 2 * wxyz[:, 1:]  # of the small turn from one image to the next
    shift = world_from_camera[after, :3, 3] - world_from_camera[before, :3, 3]
    moved = (world_from_camera[:, :3, :3].mT @ shift[..., None])[..., 0]
    return torch.cat([turned, moved], dim=1) / span_s[:, None]
