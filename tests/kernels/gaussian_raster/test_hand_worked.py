"""Answers worked out by hand; every backend that runs here must give them."""

import math

import pytest
import torch
from splat_drawing import TRITON, pinhole, render

from lidarpainter_models.kernels.gaussian_raster.blending_limits import NEAR_M

BLUR_PX2 = 0.3
VARIANCE_PX2 = (100.0 * 0.1 / 5.0) ** 2 + BLUR_PX2
WIDE = pinhole(fx_px=100.0, fy_px=100.0, cx_px=20.5, cy_px=4.5, width_px=41, height_px=9)
ROUNDING = 2e-6  # float32 and the polynomial exponential of the fast backend


@pytest.fixture(params=["reference", "cpu", TRITON])
def backend(request):
    return request.param


def near(value, expected, tolerance=ROUNDING):
    return float(value) == pytest.approx(expected, abs=tolerance)


def test_splat_on_the_axis_falls_off_as_its_projected_variance(one_splat, backend):
    image = render(one_splat(), backend=backend)
    assert near(image.alpha[4, 4], 0.5)
    assert near(image.alpha[4, 6], 0.5 * math.exp(-0.5 * 4.0 / VARIANCE_PX2))
    assert near(image.alpha[1, 5], 0.5 * math.exp(-0.5 * 10.0 / VARIANCE_PX2))
    assert torch.allclose(image.rgb, 0.5 * image.alpha[..., None].expand(-1, -1, 3), atol=1e-6)
    assert torch.allclose(image.depth_m, 5.0 * image.alpha, atol=1e-5)
    assert bool(image.visible[0])


def test_splat_ends_where_alpha_falls_under_the_cut_and_not_at_three_deviations(one_splat, backend):
    splat = one_splat() | {"opacity": torch.tensor([0.9]).double(), "camera": WIDE}
    image = render(splat, backend=backend)
    reach_px = math.sqrt(2.0 * VARIANCE_PX2 * math.log(0.9 * 255.0))
    assert reach_px > 3.0 * math.sqrt(VARIANCE_PX2)
    drawn = image.alpha[4] > 0
    expected = (torch.arange(41) - 20).abs() <= reach_px
    assert torch.equal(drawn, expected)


def test_nearer_splat_is_blended_first_whatever_its_index(one_splat, backend):
    splats = one_splat(2) | {"opacity": torch.tensor([0.4, 0.6]).double()}
    splats["means"][:, 2] = torch.tensor([8.0, 5.0])
    splats["sh"][0, 0, 0] = 0.5 / 0.28209479177387814  # the far one has red 1, the near one 0.5
    image = render(splats, backend=backend)
    assert near(image.alpha[4, 4], 1.0 - 0.4 * 0.6)
    assert near(image.rgb[4, 4, 0], 0.6 * 0.5 + 0.4 * 0.4 * 1.0)
    assert near(image.depth_m[4, 4], 0.6 * 5.0 + 0.4 * 0.4 * 8.0, 1e-5)


def test_equal_depths_are_blended_in_the_order_of_their_index(one_splat, backend):
    splats = one_splat(2) | {"features": torch.eye(2).double()}
    image = render(splats, backend=backend)
    assert near(image.features[4, 4, 0], 0.5)
    assert near(image.features[4, 4, 1], 0.25)


def test_pixel_stops_before_the_splat_that_would_leave_too_little_light(one_splat, backend):
    splats = one_splat(4) | {
        "opacity": torch.tensor([0.98, 0.98, 0.98, 0.1]).double(),
        "features": torch.eye(4).double(),
    }
    image = render(splats, backend=backend)
    assert near(image.features[4, 4, 1], 0.02 * 0.98)
    # the third would leave 8e-6; the fourth would leave enough, but the pixel has stopped
    assert image.features[4, 4, 2:].tolist() == [0.0, 0.0]
    assert near(image.alpha[4, 4], 1.0 - 0.02**2)


def test_opaque_splat_is_clamped(one_splat, backend):
    splat = one_splat() | {"opacity": torch.tensor([1.0]).double()}
    assert near(render(splat, backend=backend).alpha[4, 4], 0.99)


def test_splat_nearer_than_the_near_plane_is_not_drawn(one_splat, backend):
    splat = one_splat()
    splat["means"][0, 2] = 0.99 * NEAR_M
    image = render(splat, backend=backend)
    assert not image.visible.any()
    assert image.alpha.max() == 0


def test_body_carries_its_splats(one_splat, backend):
    splats = one_splat(2) | {
        "camera_from_body": torch.eye(4).double().repeat(2, 1, 1),
        "body_index": torch.tensor([0, 1]),
        "opacity": torch.tensor([0.0, 0.5]).double(),
    }
    splats["camera_from_body"][1, :3, 3] = torch.tensor([0.1, -0.05, 0.0])
    image = render(splats, backend=backend)
    # 0.1 m at 5 m is 2 px
    assert near(image.alpha[3, 6], 0.5, 2e-3)
    assert image.alpha.argmax() == 3 * 9 + 6
    assert image.visible.tolist() == [False, True]


@pytest.mark.parametrize(
    ("axis", "coefficient", "sign"), [("x", 3, -1.0), ("y", 1, -1.0), ("z", 2, 1.0)]
)
def test_first_band_colours_by_direction_in_the_body_frame(
    one_splat, backend, axis, coefficient, sign
):
    # the camera looks along the body's x, y or z: camera_from_body takes that axis to forward
    forward = {"x": 0, "y": 1, "z": 2}[axis]
    camera_from_body = torch.eye(4).double()
    camera_from_body[:3, :3] = torch.eye(3).double().roll(2 - forward, dims=0)
    splat = one_splat() | {
        "camera_from_body": camera_from_body[None],
        "sh": torch.zeros(1, 4, 3).double(),
    }
    splat["means"] = torch.zeros(1, 3).double()
    splat["means"][0, forward] = 5.0
    splat["sh"][0, coefficient, 1] = 0.4
    image = render(splat, backend=backend)
    assert near(image.rgb[4, 4, 1] / image.alpha[4, 4], 0.5 + sign * 0.4 * 0.4886025119029199)


def test_colour_is_not_negative(one_splat, backend):
    splat = one_splat() | {"sh": torch.full((1, 1, 3), -9.0).double()}
    assert render(splat, backend=backend).rgb.abs().max() == 0
