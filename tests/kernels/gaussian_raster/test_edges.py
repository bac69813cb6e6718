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
@pytest.mark.parametrize("size_px", [(1, 1), (1, 40), (17, 15), (16, 16), (33, 1)])
def test_any_image_size_is_drawn(splats, draw, backend, size_px):
    width_px, height_px = size_px
    inputs = splats(40, width_px=width_px, height_px=height_px, features=1)
    drawn = draw(inputs, backend=backend, dtype=torch.float32)
    assert drawn.image.rgb.shape == (height_px, width_px, 3)
    assert_finite(drawn)


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
