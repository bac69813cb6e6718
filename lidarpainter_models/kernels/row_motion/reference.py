"""Motion until a pixel is read in plain torch: the law for the fast version, on any device."""

from collections.abc import Callable
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rotation_from_quaternion
from lidarpainter_models.kernels.row_motion import MOST_GROWTH, NEAR_M, ROUNDS

ReadingTimes = Callable[[Tensor], Tensor]
"""When points of the camera's frame (points, 3) are read: seconds after the middle of the image."""


def motion_until_read(
    means: Float[Tensor, "gaussians 3"],
    rotation_wxyz: Float[Tensor, "gaussians 4"],
    body_index: Int[Tensor, " gaussians"],
    camera_from_body: Float[Tensor, "bodies 3 4"],
    metres_per_s: Float[Tensor, "bodies 3 4"],
    camera: Camera,
) -> tuple[Float[Tensor, "gaussians 3"], Float[Tensor, "gaussians 3"]]:
    """See `row_motion.motion_until_read`."""
    read_s = partial(_read_s, camera=camera)
    return motion_by_times(
        means, rotation_wxyz, body_index, camera_from_body, metres_per_s, read_s=read_s
    )


@torch.no_grad()
def motion_by_times(
    means: Float[Tensor, "gaussians 3"],
    rotation_wxyz: Float[Tensor, "gaussians 4"],
    body_index: Int[Tensor, " gaussians"],
    camera_from_body: Float[Tensor, "bodies 3 4"],
    metres_per_s: Float[Tensor, "bodies 3 4"],
    *,
    read_s: ReadingTimes,
) -> tuple[Float[Tensor, "gaussians 3"], Float[Tensor, "gaussians 3"]]:
    """The same for any lens, by when it reads what it sees; `read_s` is differentiable."""
    pose = camera_from_body[body_index.long()]
    velocity = _moved(metres_per_s[body_index.long()], means)
    read = means
    for _ in range(ROUNDS):
        read = means + read_s(_moved(pose, read))[:, None] * velocity
    later_per_m = _slope(_moved(pose, read), read_s)
    axes = rotation_from_quaternion(rotation_wxyz)
    along = (later_per_m[:, None] @ pose[..., :3] @ axes)[:, 0]
    growth = 1 + along * (velocity[:, None] @ axes)[:, 0]
    return read - means, growth.clamp(1 / MOST_GROWTH, MOST_GROWTH).log()


def _moved(
    matrices: Float[Tensor, "gaussians 3 4"], points: Float[Tensor, "gaussians 3"]
) -> Float[Tensor, "gaussians 3"]:
    return (matrices[..., :3] @ points[..., None])[..., 0] + matrices[..., 3]


def _read_s(seen: Float[Tensor, "*points 3"], camera: Camera) -> Float[Tensor, "*points"]:
    """When points of the camera's frame are read, after the middle of the image."""
    focal = torch.tensor([camera.fx_px, camera.fy_px], device=seen.device, dtype=seen.dtype)
    centre = torch.tensor([camera.cx_px, camera.cy_px], device=seen.device, dtype=seen.dtype)
    return camera.read_s(seen[..., :2] / seen[..., 2:].clamp(min=NEAR_M) * focal + centre)


def _slope(seen: Float[Tensor, "points 3"], read_s: ReadingTimes) -> Float[Tensor, "points 3"]:
    """How much later a point is read per metre that it moves in the camera's frame (s/m)."""
    with torch.enable_grad():
        place = seen.detach().requires_grad_(True)
        (slope,) = torch.autograd.grad(read_s(place).sum(), place)
    return slope
