"""Gaussians where each is when its own pixel is read: images of a rolling shutter.

A camera that reads its rows one after another moves on meanwhile, and so does the traffic. Each
Gaussian is drawn as a whole, at the moment its centre's pixel is read: its centre is moved by the
velocity that it then has before the camera (as Seiskari et al. 2024 do). Shapes, colours, the sky
and the order of drawing stay those of the middle of the image. The rasteriser knows nothing of it,
and gradients reach the centres.
"""

from dataclasses import replace
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.scene_rendering import camera_from_body
from lidarpainter_models.gaussians.model.seen_gaussians import SeenGaussians
from lidarpainter_models.geometry.cameras import Camera, Shutter
from lidarpainter_models.geometry.transforms import rigid_from_tangent

_STEP_NS = 5_000_000
"""Over which velocities are taken, to both sides."""
_ROUNDS = 2  # a second guess of where a centre is read moves it by less than 0.01 px
_NEAR_M = 0.05
_FAR_AWAY_M = -1e5  # absent actors are put further behind the camera than anything is

AnyGaussians = TypeVar("AnyGaussians", GaussianSet, SeenGaussians)


def as_read(
    gaussians: AnyGaussians,
    bodies: Float[Tensor, "bodies 4 4"],
    camera: Camera,
    actors: Actors,
    timestamp_ns: int,
) -> AnyGaussians:
    """The Gaussians as the camera's shutter reads them; differentiable in the centres.

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
    focal = gaussians.means.new_tensor([camera.fx_px, camera.fy_px])
    centre = gaussians.means.new_tensor([camera.cx_px, camera.cy_px])
    read = gaussians.means
    for _ in range(_ROUNDS):
        seen = _moved(pose, read)
        pixels_uv = seen[:, :2] / seen[:, 2:].clamp(min=_NEAR_M) * focal + centre
        read = gaussians.means + camera.read_s(pixels_uv)[:, None] * velocity
    return replace(gaussians, means=read)


def _body_rates(
    camera: Camera, shutter: Shutter, actors: Actors, timestamp_ns: int
) -> Float[Tensor, "bodies 3 4"]:
    """By how much a body's points move before the camera in a second, in the body's own frame.

    A body's matrix times (point, 1). Tracks move as recorded.
    """
    before, now, after = (
        camera_from_body(
            camera.world_from_camera.double()
            @ rigid_from_tangent(shutter.twist_per_s * (step_ns * 1e-9)),
            *actors.recorded_poses(timestamp_ns + step_ns),
        ).double()
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
