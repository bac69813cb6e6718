"""Several cameras in one call are the calls of one camera, bit for bit."""

from dataclasses import dataclass, replace

import numba
import pytest
import torch
from splat_drawing import SPLATS, TRITON, home_of

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.gaussian_raster import (
    SplatImage,
    Splats,
    render_gaussians,
    render_views,
)

SHARED = ("means", "rotation_wxyz", "scale_m", "opacity", "sh", "features")
IMAGES = ("rgb", "depth_m", "alpha", "features")
BACKENDS = ["reference", "cpu", TRITON]


@dataclass
class Street:
    """The same Gaussians before cameras of different size, lens and place."""

    gaussians: dict
    transforms: torch.Tensor
    cameras: list


def street_before(splats, backend="cpu", count=150, num_views=3, dtype=torch.float32):
    size = {}
    if backend == "triton":  # it is interpreted where there is no GPU
        count, size = 12, {"width_px": 40, "height_px": 24}
    scene = splats(count, features=2, **size)
    gaussians = {name: scene[name].to(dtype) for name in SHARED}
    gaussians["body_index"] = scene["body_index"]
    transforms = scene["camera_from_body"].to(dtype).repeat(num_views, 1, 1, 1)
    cameras = []
    for place in range(num_views):
        transforms[place, :, 0, 3] += 0.4 * place
        fx_px = scene["camera"].fx_px * (1 + 0.1 * place)
        width_px = scene["camera"].width_px - 13 * place
        cameras.append(replace(scene["camera"], width_px=width_px, fx_px=fx_px))
    device = home_of(backend)
    gaussians = {name: value.to(device) for name, value in gaussians.items()}
    return Street(gaussians, transforms.to(device), cameras)


def leaves_of(street):
    gaussians = {
        name: value.clone().requires_grad_(value.is_floating_point())
        for name, value in street.gaussians.items()
    }
    return gaussians, street.transforms.clone().requires_grad_()


def drawn(gaussians, transforms, cameras, **options):
    splats = Splats(**{name: gaussians[name] for name in SPLATS})
    return render_views(splats, transforms, cameras, features=gaussians["features"], **options)


def loss_of(image, seed):
    generator = torch.Generator().manual_seed(seed)
    total = image.rgb.new_zeros(())
    for name in IMAGES:
        drawn = getattr(image, name)
        weight = torch.randn(drawn.shape, generator=generator).to(drawn)
        total = total + (drawn * weight).sum()
    return total


def alone(street, place, backend):
    """One view by a call of its own, with gradients."""
    gaussians, transforms = leaves_of(street)
    absolute = transforms.new_zeros(len(gaussians["means"]))
    image = render_gaussians(
        Splats(**{name: gaussians[name] for name in SPLATS}),
        transforms[place],
        street.cameras[place],
        features=gaussians["features"],
        screen_gradient_out=absolute,
        backend=backend,
    )
    loss_of(image, place).backward()
    return image, {name: gaussians[name].grad for name in SHARED}, transforms.grad, absolute


def together(street, backend):
    gaussians, transforms = leaves_of(street)
    absolute = transforms.new_full((len(street.cameras), len(gaussians["means"])), 7.0)
    images = drawn(
        gaussians, transforms, street.cameras, screen_gradients_out=absolute, backend=backend
    )
    sum(loss_of(image, place) for place, image in enumerate(images)).backward()
    return images, {name: gaussians[name].grad for name in SHARED}, transforms.grad, absolute


def assert_same_images(image: SplatImage, expected: SplatImage):
    for name in (*IMAGES, "visible", "radius_px"):
        assert torch.equal(getattr(image, name), getattr(expected, name)), name


@pytest.mark.parametrize("backend", BACKENDS)
def test_each_view_is_that_of_a_call_of_its_own(splats, backend):
    street = street_before(splats, backend)
    images, gradients, to_transforms, absolute = together(street, backend)
    sums = {name: torch.zeros_like(value) for name, value in gradients.items()}
    for place in range(3):
        image, own, to_own_transforms, own_absolute = alone(street, place, backend)
        assert_same_images(images[place], image)
        assert torch.equal(absolute[place], own_absolute)
        assert torch.equal(to_transforms[place], to_own_transforms[place])
        for name, gradient in own.items():
            sums[name] += gradient
    for name, gradient in gradients.items():
        if backend != "reference":
            assert torch.equal(gradient, sums[name]), name
        else:  # autograd adds in an order of its own
            assert (gradient - sums[name]).norm() < 1e-6 * sums[name].norm(), name


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_view_that_the_loss_leaves_out_adds_nothing(splats, backend):
    street = street_before(splats, backend)
    gaussians, transforms = leaves_of(street)
    images = drawn(gaussians, transforms, street.cameras, backend=backend)
    loss_of(images[1], 1).backward()
    _, own, to_own_transforms, _ = alone(street, 1, backend)
    for name, gradient in own.items():
        assert torch.equal(gaussians[name].grad, gradient), name
    assert torch.equal(transforms.grad, to_own_transforms)


def test_threads_change_no_bit_of_several_views(splats):
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one core")
    street, before = street_before(splats), numba.get_num_threads()
    found = []
    try:
        for threads in (1, 2):
            numba.set_num_threads(threads)
            found.append(together(street, "cpu"))
    finally:
        numba.set_num_threads(before)
    for first, second in zip(found[0][0], found[1][0], strict=True):
        assert_same_images(first, second)
    assert all(torch.equal(found[0][1][name], found[1][1][name]) for name in SHARED)


def test_no_view_gives_no_image(splats):
    street = street_before(splats)
    assert drawn(street.gaussians, street.transforms[:0], []) == []


def test_views_that_do_not_fit_together_are_refused(splats):
    street = street_before(splats)
    with pytest.raises(ShapeError, match=r"camera_from_body needs shape \(2, 3, 4, 4\)"):
        drawn(street.gaussians, street.transforms, street.cameras[:2])
    with pytest.raises(ShapeError, match="3 views and 150 Gaussians"):
        drawn(
            street.gaussians,
            street.transforms,
            street.cameras,
            screen_gradients_out=torch.zeros(3, 2),
        )
