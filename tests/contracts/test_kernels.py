"""Every fast kernel gives what its plain reference gives, however its input lies in memory.

A kernel with a door of a few tensors is tried here through `CASES`; one that needs scenes of its
own (gradients, several views) has a suite below `tests/kernels/`.
"""

import pkgutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from splat_drawing import TRITON, home_of
from torch import Tensor

from lidarpainter_models import kernels
from lidarpainter_models.errors import BackendError
from lidarpainter_models.geometry.cameras import Camera, Shutter
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.kernels.backends import available_backends
from lidarpainter_models.kernels.box_owners import box_owners
from lidarpainter_models.kernels.point_blend import blend_points
from lidarpainter_models.kernels.point_splat import splat_points
from lidarpainter_models.kernels.row_motion import motion_until_read

SUITES = Path(__file__).resolve().parents[1] / "kernels"
HEIGHT_PX, WIDTH_PX = 30, 45


@dataclass(frozen=True)
class Case:
    """Seeded input of a kernel by its size, and how far two backends may be apart."""

    make: Callable[[int, torch.Generator], dict[str, Any]]
    call: Callable[..., Any]
    tolerance: float
    """0 where a selection is made; otherwise what float32 leaves of sums in another order."""


def random_points(count: int, generator: torch.Generator) -> dict[str, Any]:
    size = torch.tensor([WIDTH_PX + 8, HEIGHT_PX + 8])
    pixels = (torch.rand(count, 2, generator=generator) * size - 4).long()
    depth_m = torch.randint(-1, 20, (count,), generator=generator) / 2.0  # many are as far
    depth_m[::17], depth_m[5::29] = torch.inf, torch.nan
    radius_px = torch.randint(0, 4, (count,), generator=generator)
    return {"pixels_uv": pixels, "depth_m": depth_m, "radius_px": radius_px}


def random_discs(count: int, generator: torch.Generator) -> dict[str, Any]:
    size = torch.tensor([WIDTH_PX, HEIGHT_PX]).float()
    return {
        "positions_uv": torch.rand(count, 2, generator=generator) * size,
        "depth_m": 9.8 + 0.4 * torch.rand(count, generator=generator),
        "attributes": torch.rand(count, 3, generator=generator),
        "surface_depth_m": 10.0 * (torch.rand(HEIGHT_PX, WIDTH_PX, generator=generator) < 0.8),
        "weight": torch.rand(count, generator=generator),
        "radius_px": 0.5 + 3 * torch.rand(count, generator=generator),
    }


def random_boxes(count: int, generator: torch.Generator) -> dict[str, Any]:
    tangents = 2 * torch.randn(7, 6, generator=generator).double()
    return {
        "points_m": 3 * torch.randn(count, 3, generator=generator),
        "box_from_points": rigid_from_tangent(tangents),
        "size_m": 1 + 3 * torch.rand(7, 3, generator=generator),
    }


def random_motion(count: int, generator: torch.Generator) -> dict[str, Any]:
    poses = rigid_from_tangent(0.2 * torch.randn(3, 6, generator=generator)).float()
    poses[:, 2, 3] += 6
    rates = torch.randn(3, 3, 4, generator=generator) * torch.tensor([0.2, 0.2, 0.2, 10.0])
    rates[2] = 0  # an absent actor
    return {
        "means": 4 * torch.randn(count, 3, generator=generator),
        "rotation_wxyz": torch.randn(count, 4, generator=generator),
        "body_index": torch.randint(0, 3, (count,), generator=generator),
        "camera_from_body": poses[:, :3],
        "metres_per_s": rates,
    }


SHUTTER = Shutter(across_s=(0.004, 0.04), twist_per_s=torch.zeros(6))
READING = replace(
    Camera.centred(torch.eye(4).double(), 40.0, width_px=WIDTH_PX, height_px=HEIGHT_PX),
    shutter=SHUTTER,
)
CASES = {
    "row_motion": Case(random_motion, partial(motion_until_read, camera=READING), 1e-5),
    "box_owners": Case(random_boxes, partial(box_owners, margin_m=0.2, floor_m=0.3), 0.0),
    "point_splat": Case(
        random_points, partial(splat_points, height_px=HEIGHT_PX, width_px=WIDTH_PX), 0.0
    ),
    "point_blend": Case(random_discs, blend_points, 2e-5),
}
KERNELS = sorted(
    module.name
    for module in pkgutil.iter_modules(kernels.__path__)
    if module.ispkg and "reference" in available_backends(module.name)
)
COUNTS = [0, 1, 2, 33, 257]
FAST = [
    pytest.param(kernel, backend, count, marks=TRITON.marks if backend == "triton" else [])
    for kernel in CASES
    for backend in available_backends(kernel)
    for count in COUNTS
    if backend != "reference"
]


@pytest.mark.parametrize("kernel", KERNELS)
def test_every_kernel_is_tried_against_its_reference(kernel):
    suites = (SUITES / kernel, *SUITES.glob(f"**/test_{kernel}*.py"))
    assert kernel in CASES or any(suite.exists() for suite in suites)


def drawn(kernel: str, count: int, *, strided: bool) -> dict[str, Any]:
    """Input of a case; strided, every tensor is every second row of a larger one."""
    inputs = CASES[kernel].make(count, torch.Generator().manual_seed(count))
    if not strided:
        return inputs
    spread = {}
    for name, value in inputs.items():
        spread[name] = torch.stack([value, torch.zeros_like(value)], dim=1)[:, 0]
        assert len(value) < 2 or not spread[name].is_contiguous()
    return spread


@pytest.mark.parametrize("strided", [False, True])
@pytest.mark.parametrize(("kernel", "backend", "count"), FAST)
def test_a_fast_kernel_agrees_with_the_reference(kernel, backend, count, strided):
    case, inputs = CASES[kernel], drawn(kernel, count, strided=strided)
    moved = {name: value.to(home_of(backend)) for name, value in inputs.items()}
    found = case.call(**moved, backend=backend)
    expected = case.call(**inputs, backend="reference")
    before = drawn(kernel, count, strided=strided)
    torch.testing.assert_close(inputs, before, rtol=0, atol=0, equal_nan=True)
    for one, other in zip(tensors(found), tensors(expected), strict=True):
        torch.testing.assert_close(one.cpu(), other, rtol=case.tolerance, atol=case.tolerance)


@pytest.mark.parametrize("kernel", CASES)
def test_equal_input_gives_equal_bits(kernel):
    first, again = (
        tensors(CASES[kernel].call(**drawn(kernel, 257, strided=False), backend="auto"))
        for _ in range(2)
    )
    assert all(torch.equal(*pair) for pair in zip(first, again, strict=True))


@pytest.mark.parametrize("kernel", CASES)
def test_a_backend_that_is_not_here_is_refused(kernel):
    missing = {"cpu", "cuda"} - set(available_backends(kernel))
    for backend in missing:
        with pytest.raises(BackendError, match=f"no '{backend}' backend here"):
            CASES[kernel].call(**drawn(kernel, 3, strided=False), backend=backend)


def tensors(found: Tensor | tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return found if isinstance(found, tuple) else (found,)
