"""Seeded Gaussians in front of a camera, and what a backend makes of them."""

from dataclasses import dataclass

import pytest
import torch
from splat_drawing import pinhole, render
from torch import Tensor

from lidarpainter_models.geometry.transforms import rotation_from_quaternion
from lidarpainter_models.kernels.gaussian_raster import SplatImage

DIFFERENTIABLE = (
    "means",
    "rotation_wxyz",
    "scale_m",
    "opacity",
    "sh",
    "camera_from_body",
    "features",
)


@dataclass(frozen=True, kw_only=True)
class DrawnSplats:
    """An image and the gradients of a fixed random loss on it, all float64."""

    image: SplatImage
    gradients: dict[str, Tensor]
    absolute_gradient: Tensor


def random_splats(
    count,
    *,
    seed=0,
    width_px=70,
    height_px=50,
    coefficients=16,
    features=0,
    num_bodies=3,
    size_px=4.0,
):
    """A scene for `splat_drawing.render`; some Gaussians lie outside the image or behind."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    focal_px = 0.6 * width_px
    z = torch.where(uniform(count) < 0.05, -1.0, 1.0) * (1.0 + 20.0 * uniform(count))
    x = (1.4 * uniform(count) - 0.7) * width_px / focal_px * z
    y = (1.4 * uniform(count) - 0.7) * height_px / focal_px * z
    turns = torch.tensor([1.0, 0.0, 0.0, 0.0]).double() + 0.05 * normal(num_bodies, 4)
    camera_from_body = torch.eye(4, dtype=torch.float64).repeat(num_bodies, 1, 1)
    camera_from_body[:, :3, :3] = rotation_from_quaternion(turns)
    camera_from_body[:, :3, 3] = 0.3 * normal(num_bodies, 3)
    splats = {
        "means": torch.stack([x, y, z], dim=1),
        "rotation_wxyz": normal(count, 4),
        "scale_m": torch.exp(0.7 * normal(count, 3)) * (size_px * z.abs() / focal_px / 2)[:, None],
        "opacity": torch.sigmoid(2.0 * normal(count)),
        "sh": 0.3 * normal(count, coefficients, 3),
        "camera_from_body": camera_from_body,
        "features": normal(count, features),
    }
    # both backends get the same numbers: those a float32 can hold
    splats = {name: value.float().double() for name, value in splats.items()}
    splats["body_index"] = torch.randint(0, num_bodies, (count,), generator=generator)
    splats["camera"] = pinhole(
        fx_px=focal_px,
        fy_px=1.05 * focal_px,
        cx_px=0.5 * width_px + 1.3,
        cy_px=0.5 * height_px - 0.8,
        width_px=width_px,
        height_px=height_px,
    )
    return splats


def draw_and_go_back(splats, *, backend, dtype):
    """Draw and differentiate a weighted sum of every image; the weights are seeded."""
    splats = dict(splats)
    for name in DIFFERENTIABLE:
        splats[name] = splats[name].to(dtype, copy=True).requires_grad_()
    absolute = splats["means"].new_zeros(len(splats["means"]), dtype=dtype)
    image = render(splats, backend=backend, screen_gradient_out=absolute)
    generator = torch.Generator().manual_seed(99)
    loss = image.rgb.new_zeros(())
    for channels in (image.rgb, 0.05 * image.depth_m, image.alpha, image.features):
        weight = torch.randn(channels.shape, generator=generator, dtype=torch.float64)
        loss = loss + (channels * weight.to(channels)).sum()
    loss.backward()
    gradients = {name: splats[name].grad.double() for name in DIFFERENTIABLE}
    return DrawnSplats(image=image, gradients=gradients, absolute_gradient=absolute.double())


@pytest.fixture
def splats():
    """`random_splats`, for tests to call."""
    return random_splats


@pytest.fixture
def draw():
    """`draw_and_go_back`, for tests to call."""
    return draw_and_go_back


@pytest.fixture
def one_splat():
    """A grey-free splat on the axis: z 5 m, standard deviation 0.1 m, 100 px focal, 9 x 9 px."""

    def build(count=1):
        return {
            "means": torch.tensor([[0.0, 0.0, 5.0]]).double().repeat(count, 1),
            "rotation_wxyz": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).double().repeat(count, 1),
            "scale_m": torch.full((count, 3), 0.1, dtype=torch.float64),
            "opacity": torch.full((count,), 0.5, dtype=torch.float64),
            "sh": torch.zeros(count, 1, 3, dtype=torch.float64),
            "body_index": torch.zeros(count, dtype=torch.int64),
            "camera_from_body": torch.eye(4, dtype=torch.float64)[None],
            "camera": pinhole(
                fx_px=100.0, fy_px=100.0, cx_px=4.5, cy_px=4.5, width_px=9, height_px=9
            ),
        }

    return build
