"""Hundreds of scenes nobody would draw: fast backends agree with float64 autograd or give zero.

Small images and few Gaussians, each of an extreme kind, so that hundreds of them take seconds.
A pixel that sits on a threshold (the alpha cut, the stop, the clamp, two Gaussians at one depth)
may fall on either side in float32: what such a flip can move is granted, and nothing more.
"""

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from splat_drawing import TRITON, pinhole, render

from lidarpainter_models.kernels.gaussian_raster.blending_limits import ALPHA_CUT, NEAR_M

KINDS = ("plain", "needle", "huge", "behind", "near plane", "clear", "solid", "tiny")
LEARNED = ("means", "rotation_wxyz", "scale_m", "opacity", "sh")
# float32 against float64; needles turn by float32 rounding times their length
IMAGE_ERROR = 2e-5
GRADIENT_ERROR = 2e-3
MOST_FLIPS = 3
"""Scenes of them that may hold a pixel on a threshold; none was seen to."""


def gaussian_of(kind, generator):
    """Means, scale and opacity of one Gaussian."""
    z = generator.uniform(0.5, 6.0)
    mean = np.array([generator.normal() * 0.4 * z, generator.normal() * 0.4 * z, z])
    scale = np.exp(generator.normal(size=3) - 1.5)
    opacity = generator.uniform(0.05, 0.95)
    if kind == "needle":
        scale = np.array([generator.uniform(2.0, 30.0), 0.01, 0.01])
    elif kind == "huge":
        scale = np.full(3, generator.uniform(30.0, 1e4))
    elif kind == "behind":
        mean[2] = -mean[2]
    elif kind == "near plane":
        mean[2] = NEAR_M * (1.0 + generator.choice([-1e-3, 1e-3, 0.5]))
    elif kind == "clear":
        opacity = generator.choice([0.0, 0.9 * ALPHA_CUT])
    elif kind == "solid":
        opacity = 1.0
    elif kind == "tiny":
        scale = np.full(3, 1e-5)
    return mean, scale, opacity


def scene_of(kinds, seed, size_px):
    """A scene for `splat_drawing.render` in numbers that float32 holds."""
    generator = np.random.default_rng(seed)
    count = len(kinds)
    parts = [gaussian_of(kind, generator) for kind in kinds]
    values = {
        "means": np.array([mean for mean, _, _ in parts]).reshape(count, 3),
        "rotation_wxyz": generator.normal(size=(count, 4)),
        "scale_m": np.array([scale for _, scale, _ in parts]).reshape(count, 3),
        "opacity": np.array([opacity for _, _, opacity in parts]).reshape(count),
        "sh": 0.5 * generator.normal(size=(count, 4, 3)),
    }
    scene = {name: torch.from_numpy(np.float32(value)) for name, value in values.items()}
    scene["body_index"] = torch.zeros(count, dtype=torch.int32)
    scene["camera_from_body"] = torch.eye(4)[None]
    width_px, height_px = size_px
    scene["camera"] = pinhole(
        fx_px=12.0,
        fy_px=12.0,
        cx_px=width_px / 2,
        cy_px=height_px / 2,
        width_px=width_px,
        height_px=height_px,
    )
    return scene


def drawn(scene, backend, dtype):
    """Images and gradients of a fixed loss, as float64."""
    scene = dict(scene)
    for name in (*LEARNED, "camera_from_body"):
        scene[name] = scene[name].to(dtype, copy=True).requires_grad_()
    image = render(scene, backend=backend)
    weight = torch.linspace(0.5, 1.5, image.alpha.numel(), dtype=dtype).view_as(image.alpha)
    loss = (image.rgb * weight[..., None]).sum() + (image.alpha * weight).sum()
    loss = loss + 0.05 * (image.depth_m * weight).sum()
    if loss.requires_grad:
        loss.backward()
    gradients = {
        name: torch.zeros_like(scene[name]) if scene[name].grad is None else scene[name].grad
        for name in (*LEARNED, "camera_from_body")
    }
    return image, {name: gradient.double() for name, gradient in gradients.items()}


def disagreement(scene, backend):
    """Why a backend is wrong about a scene; None where it is right."""
    image, gradients = drawn(scene, backend, torch.float32)
    images = {name: getattr(image, name).detach() for name in ("rgb", "depth_m", "alpha")}
    for name, value in (images | gradients).items():
        assert bool(torch.isfinite(value).all()), f"{name} is not finite"
    hidden = ~image.visible
    for name in LEARNED:
        assert not gradients[name][hidden].any(), f"{name} of an unseen Gaussian has a gradient"
    truth, true_gradients = drawn(scene, "reference", torch.float64)
    if not torch.equal(image.visible, truth.visible):
        return "visible"
    for name, value in images.items():
        error = (value.double() - getattr(truth, name).detach()).abs().max()
        if error > IMAGE_ERROR * (1.0 + getattr(truth, name).detach().abs().max()):
            return name
    for name, gradient in gradients.items():
        scale = true_gradients[name].norm()
        if (gradient - true_gradients[name]).norm() > GRADIENT_ERROR * scale + 1e-6:
            return f"gradient of {name}"
    return None


def disagreements(backend, count):
    """Of so many scenes, those that a backend gets wrong."""
    found: list[str] = []

    @settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(
        kinds=st.lists(st.sampled_from(KINDS), min_size=0, max_size=6),
        seed=st.integers(0, 2**31),
        size_px=st.sampled_from([(1, 1), (1, 9), (8, 6), (17, 3)]),
    )
    def check_scenes(kinds, seed, size_px):
        reason = disagreement(scene_of(kinds, seed, size_px), backend)
        if reason is not None:
            found.append(f"{kinds} {seed} {size_px}: {reason}")

    check_scenes()
    return found


@pytest.mark.parametrize(
    ("backend", "count"),
    [
        ("cpu", 300),
        pytest.param("cpu", 1000, marks=pytest.mark.slow),
        pytest.param("triton", 10, marks=TRITON.marks),
        pytest.param("triton", 300, marks=[*TRITON.marks, pytest.mark.slow]),
    ],
)
def test_scenes_are_finite_and_agree_with_float64(backend, count):
    found = disagreements(backend, count)
    assert len(found) <= (MOST_FLIPS if count > 100 else 0), found
