"""Gaussians where each is when its own pixel is read: images of a rolling shutter.

A camera that reads its rows one after another moves on meanwhile, and so does the traffic. Each
Gaussian is drawn at the moment its centre's pixel is read: its centre is moved by the velocity that
it then has before the camera (as Seiskari et al. 2024 do), and each of its axes grows by as much as
its ends are moved apart, being read one after the other: else the near road tears. Directions of
axes, colours, the sky and the order of drawing stay those of the middle of the image. The
rasteriser knows nothing of it, and gradients reach centres and sizes.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.drawing import camera_from_body
from lidarpainter_models.gaussians.model.seen_gaussians import AnyGaussians
from lidarpainter_models.geometry.cameras import Camera, Shutter
from lidarpainter_models.geometry.transforms import (
    rigid_from_tangent,
    rotation_from_quaternion,
)

_STEP_NS = 5_000_000
"""Over which velocities are taken, to both sides."""
_ROUNDS = 2  # a second guess of where a centre is read moves it by less than 0.01 px
_NEAR_M = 0.05
MOST_GROWTH = 2.0
"""By which an axis is made longer at most, or shorter: what passes right before a camera."""
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
    device, body = gaussians.means.device, gaussians.body_index.long()
    pose = bodies.detach().to(device)[body, :3]
    rate = _body_rates(camera, shutter, actors, timestamp_ns).to(device)[body]
    velocity = _moved(rate, gaussians.means)
    read = gaussians.means
    for _ in range(_ROUNDS):
        later_s = camera.read_s(_pixels_of(_moved(pose, read), camera))
        read = gaussians.means + later_s[:, None] * velocity
    growth = _growth(gaussians, _moved(pose, read), pose[..., :3], velocity, camera)
    return replace(gaussians, means=read, log_scale=gaussians.log_scale + growth.log())


@torch.no_grad()
def _growth(
    gaussians: AnyGaussians,
    seen: Float[Tensor, "gaussians 3"],
    turn: Float[Tensor, "gaussians 3 3"],
    velocity: Float[Tensor, "gaussians 3"],
    camera: Camera,
) -> Float[Tensor, "gaussians 3"]:
    """How much longer each axis is as read; centres are `seen` in the camera, velocities not."""
    axes = rotation_from_quaternion(gaussians.rotation_wxyz)
    reach = (turn @ (axes * gaussians.scale_m[:, None])).mT
    before, after = (
        camera.read_s(_pixels_of(ends.flatten(0, 1), camera)).unflatten(0, (-1, 3))
        for ends in (seen[:, None] - reach, seen[:, None] + reach)
    )
    apart_m = (after - before) / 2 * (velocity[:, None] @ axes)[:, 0]
    return (1 + apart_m / gaussians.scale_m).clamp(1 / MOST_GROWTH, MOST_GROWTH)


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
    rates = _body_rates(camera, shutter, actors, timestamp_ns).to(bodies)
    way = torch.nn.functional.pad(half_s * rates, (0, 0, 0, 1))
    return [bodies - bodies @ way, bodies + bodies @ way]


def _bodies_after(
    camera: Camera, shutter: Shutter, actors: Actors, timestamp_ns: int, step_ns: int
) -> Float[Tensor, "bodies 4 4"]:
    moved = rigid_from_tangent(shutter.twist_per_s * (step_ns * 1e-9))
    poses = actors.recorded_poses(timestamp_ns + step_ns)
    return camera_from_body(camera.world_from_camera.double() @ moved, *poses)


def _body_rates(
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


def _moved(
    matrices: Float[Tensor, "gaussians 3 4"], points: Float[Tensor, "gaussians 3"]
) -> Float[Tensor, "gaussians 3"]:
    return (matrices[..., :3] @ points[..., None])[..., 0] + matrices[..., 3]


def _pixels_of(seen: Float[Tensor, "points 3"], camera: Camera) -> Float[Tensor, "points 2"]:
    """Continuous pixel positions of points of the camera's frame, none nearer than `_NEAR_M`."""
    focal = seen.new_tensor([camera.fx_px, camera.fy_px])
    centre = seen.new_tensor([camera.cx_px, camera.cy_px])
    return seen[:, :2] / seen[:, 2:].clamp(min=_NEAR_M) * focal + centre
