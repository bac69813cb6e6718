"""Whatever is given, nothing crashes and no number is NaN."""

import pytest
import torch
from splat_drawing import SPLATS, TRITON, render

from lidarpainter_models.errors import ShapeError

FAST = ["cpu", TRITON]
BACKENDS = ["reference", *FAST]


def assert_finite(drawn):
    for name in ("rgb", "depth_m", "alpha", "features"):
        assert bool(torch.isfinite(getattr(drawn.image, name)).all()), name
    for name, gradient in drawn.gradients.items():
        assert bool(torch.isfinite(gradient).all()), name
    assert bool(torch.isfinite(drawn.absolute_gradient).all())


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_gaussians_give_black_images(splats, draw, backend):
    drawn = draw(splats(0, features=2), backend=backend, dtype=torch.float32)
    assert drawn.image.rgb.shape == (50, 70, 3)
    assert drawn.image.features.shape == (50, 70, 2)
    assert drawn.image.alpha.abs().max() == 0
    assert drawn.gradients["camera_from_body"].abs().max() == 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_gaussians_behind_the_camera_give_black_images_and_no_gradient(splats, draw, backend):
    inputs = splats(20)
    inputs["means"][:, 2] = -inputs["means"][:, 2].abs() - 2.0
    drawn = draw(inputs, backend=backend, dtype=torch.float32)
    assert drawn.image.alpha.abs().max() == 0
    assert not drawn.image.visible.any()
    assert not any(gradient.any() for gradient in drawn.gradients.values())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("size_px", [(1, 1), (1, 40), (17, 15), (16, 16), (33, 1)])
def test_any_image_size_is_drawn(splats, draw, backend, size_px):
    width_px, height_px = size_px
    inputs = splats(40, width_px=width_px, height_px=height_px, features=1)
    drawn = draw(inputs, backend=backend, dtype=torch.float32)
    assert drawn.image.rgb.shape == (height_px, width_px, 3)
    assert_finite(drawn)


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize(
    "scale_m",
    [
        (1e-6, 1e-6, 1e-6),
        (1e3, 1e3, 1e3),
        (1e6, 1e-6, 1e-6),
        (1e4, 1e4, 1e-8),
        (0.0, 0.0, 0.0),
        (1e-30, 1.0, 1e30),
    ],
)
def test_huge_tiny_flat_and_needle_gaussians_stay_finite(splats, draw, backend, scale_m):
    inputs = splats(12, width_px=40, height_px=24, features=1)
    inputs["scale_m"] = torch.tensor(scale_m).double().repeat(12, 1)
    assert_finite(draw(inputs, backend=backend, dtype=torch.float32))


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("scale_m", [(30.0, 0.01, 0.01), (20.0, 20.0, 0.01), (200.0, 0.01, 5.0)])
def test_needles_and_walls_match_the_reference(splats, draw, backend, scale_m):
    inputs = splats(15, seed=7, width_px=40, height_px=24)
    inputs["scale_m"] = torch.tensor(scale_m).double().repeat(15, 1)
    inputs["opacity"] = inputs["opacity"].clamp(max=0.5)
    expected = draw(inputs, backend="reference", dtype=torch.float64)
    actual = draw(inputs, backend=backend, dtype=torch.float32)
    assert (actual.image.alpha - expected.image.alpha).detach().abs().mean() < 1e-5
    for name in ("opacity", "sh"):
        difference = actual.gradients[name] - expected.gradients[name]
        # needles are sensitive: a row's place on one moves by float32 rounding times its slope
        assert difference.norm() < 1e-4 * expected.gradients[name].norm()


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("opacity", [0.0, 1.0 / 256.0, 1.0])
def test_extreme_opacities_stay_finite(splats, draw, backend, opacity):
    inputs = splats(20, width_px=40, height_px=24)
    inputs["opacity"] = torch.full((20,), opacity).double()
    drawn = draw(inputs, backend=backend, dtype=torch.float32)
    assert_finite(drawn)
    assert bool(drawn.image.visible.any()) == (opacity == 1.0)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["means", "rotation_wxyz", "scale_m", "opacity", "sh"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_gaussian_that_is_not_finite_is_left_out(splats, backend, name, value):
    inputs = splats(30, coefficients=1, width_px=40, height_px=24)
    inputs = {
        k: v.float() if torch.is_tensor(v) and v.is_floating_point() else v
        for k, v in inputs.items()
    }
    rest = inputs | {key: inputs[key][1:] for key in (*SPLATS, "features")}
    inputs[name].view(30, -1)[0] = value
    image = render(inputs, backend=backend)
    assert not image.visible[0]
    expected = render(rest, backend=backend)
    assert torch.equal(image.rgb, expected.rgb)


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("position_m", [1e-4, 0.1, 0.100001])
def test_gaussian_at_the_near_plane_and_far_aside_stays_finite(splats, draw, backend, position_m):
    inputs = splats(8)
    inputs["camera_from_body"] = torch.eye(4).double().repeat(3, 1, 1)
    inputs["means"] = torch.tensor([[1e4, -1e3, position_m]]).double().repeat(8, 1)
    assert_finite(draw(inputs, backend=backend, dtype=torch.float32))


@pytest.mark.parametrize("backend", FAST)
def test_second_backward_pass_gives_the_same_gradient(splats, backend):
    inputs = splats(8, width_px=20, height_px=20)
    inputs["means"].requires_grad_()
    loss = render(inputs, backend=backend).rgb.square().sum()
    (first,) = torch.autograd.grad(loss, inputs["means"], retain_graph=True)
    (second,) = torch.autograd.grad(loss, inputs["means"])
    assert torch.equal(first, second)
    assert first.dtype == torch.float64


def test_input_that_does_not_belong_together_is_refused(splats):
    inputs = splats(4)
    with pytest.raises(ShapeError, match=r"opacity needs shape \(4,\)"):
        render(inputs | {"opacity": torch.ones(3)})
    with pytest.raises(ShapeError, match="1, 4, 9 or 16"):
        render(inputs | {"sh": torch.ones(4, 5, 3)})
    with pytest.raises(ShapeError, match="holds 3 bodies"):
        render(inputs | {"body_index": torch.full((4,), 3)})
    with pytest.raises(ShapeError, match=r"each of 4 Gaussians, got shape \(3,\)"):
        render(inputs, screen_gradient_out=torch.ones(3))
    with pytest.raises(ShapeError, match=r"features needs shape \(4, 2\)"):
        render(inputs | {"features": torch.ones(3, 2)})
    with pytest.raises(ShapeError, match=r"camera_from_body needs shape \(3, 4, 4\)"):
        render(inputs | {"camera_from_body": torch.ones(3, 3, 4)})
