"""Gaussians where each is when its own pixel is read: images of a rolling shutter.

A camera that reads its rows one after another moves on meanwhile, and so does the traffic. Each
Gaussian is drawn at the moment its centre's pixel is read: its centre is moved by the velocity that
it then has before the camera (as Seiskari et al. 2024 do), and each of its axes grows by as much as
its ends are moved apart, being read one after the other: else the near road tears. Directions of
axes, colours, the sky and the order of drawing stay those of the middle of the image. The
rasteriser knows nothing of it. Gradients reach centres and sizes as if all were read at once: one
step of a fit moves a centre too little to change when it is read.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.drawing import camera_from_body
from lidarpainter_models.gaussians.model.seen_gaussians import AnyGaussians
from lidarpainter_models.geometry.cameras import Camera, Shutter
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.kernels.row_motion import motion_until_read

_STEP_NS = 5_000_000
"""Over which velocities are taken, to both sides."""
_FAR_AWAY_M = -1e5  # absent actors are put further behind the camera than anything is


def as_read(
    gaussians: AnyGaussians,
    bodies: Float[Tensor, "bodies 4 4"],
    camera: Camera,
    actors: Actors,
    timestamp_ns: int,
) -> AnyGaussians:
    """The Gaussians as the camera's shutter reads them; differentiable in centres and sizes.

    Bodies stand before the camera in the middle of the image, at `timestamp_ns`. A camera without a
    rolling shutter gets the Gaussians back as they are.
    """
    shutter = camera.shutter
    if shutter is None or not shutter.is_rolling:
        return gaussians
    offset_m, log_growth = motion_until_read(
        gaussians.means,
        gaussians.rotation_wxyz,
        gaussians.body_index,
        bodies[:, :3],
        body_rates(camera, shutter, actors, timestamp_ns),
        camera,
    )
    return replace(
        gaussians, means=gaussians.means + offset_m, log_scale=gaussians.log_scale + log_growth
    )


def bodies_while_read(
    bodies: Float[Tensor, "bodies 4 4"], camera: Camera, actors: Actors, timestamp_ns: int
) -> list[Float[Tensor, "bodies 4 4"]]:
    """Where bodies stand before the camera when its first pixel is read, and when its last one is.

    None for an image that is read at once. As `as_read` moves what stands so in its middle.
    """
    shutter = camera.shutter
    if shutter is None or not shutter.is_rolling:
        return []
    half_s = sum(map(abs, shutter.across_s)) / 2
    return bodies_apart(bodies, body_rates(camera, shutter, actors, timestamp_ns), half_s)


def bodies_apart(
    bodies: Float[Tensor, "bodies 4 4"], rates: Float[Tensor, "bodies 3 4"], half_s: float
) -> list[Float[Tensor, "bodies 4 4"]]:
    """Where bodies stand before the camera so long before and so long after, by `body_rates`."""
    way = torch.nn.functional.pad(half_s * rates.to(bodies), (0, 0, 0, 1))
    return [bodies - bodies @ way, bodies + bodies @ way]


def _bodies_after(
    camera: Camera, shutter: Shutter, actors: Actors, timestamp_ns: int, step_ns: int
) -> Float[Tensor, "bodies 4 4"]:
    moved = rigid_from_tangent(shutter.twist_per_s * (step_ns * 1e-9))
    poses = actors.recorded_poses(timestamp_ns + step_ns)
    return camera_from_body(camera.world_from_camera.double() @ moved, *poses)


def body_rates(
    camera: Camera, shutter: Shutter, actors: Actors, timestamp_ns: int
) -> Float[Tensor, "bodies 3 4"]:
    """By how much a body's points move before the camera in a second, in the body's own frame.

    A body's matrix times (point, 1). Tracks move as recorded.
    """
    before, now, after = (
        _bodies_after(camera, shutter, actors, timestamp_ns, step_ns).double()
        for step_ns in (-_STEP_NS, 0, _STEP_NS)
    )
    per_s = (after - before)[:, :3] / (2e-9 * _STEP_NS)
    is_there = (now[:, 2, 3] > _FAR_AWAY_M) & (before[:, 2, 3] > _FAR_AWAY_M)
    is_there &= after[:, 2, 3] > _FAR_AWAY_M
    rates = torch.where(is_there[:, None, None], now[:, :3, :3].mT @ per_s, 0.0)
    return rates.float()
