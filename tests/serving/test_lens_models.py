"""Lenses as simulators describe them, against OpenCV and against worked numbers."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from lidarpainter_models.serving.lens_models import (
    PinholeLens,
    RadialLens,
    RisingCurve,
    SensorCamera,
    Windshield,
)

WIDTH_PX, HEIGHT_PX = 96, 54
RADIAL = (-0.3, 0.1, -0.02, 0.05, 0.01, 0.002)
TANGENTIAL = (0.001, -0.002)
PRISM = (0.001, -0.0005, 0.0007, 0.0002)
KANNALA = (-0.02, 0.002, 0.001, -0.0003)


def camera_of(lens, focal_px, **changes):
    return SensorCamera(
        lens=lens,
        pixels_per_unit=(focal_px, 0.0, 0.0, 1.01 * focal_px),
        middle_px=(47.0, 28.5),
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
        **changes,
    )


def fisheye(max_angle_rad):
    k1, k2, k3, k4 = KANNALA
    curve = RisingCurve((0.0, 1.0, 0.0, k1, 0.0, k2, 0.0, k3, 0.0, k4), max_angle_rad)
    return RadialLens(curve, is_of_angle=True, max_angle_rad=max_angle_rad)


PINHOLE = camera_of(PinholeLens(RADIAL, TANGENTIAL, PRISM), 100.0)
FISHEYE = camera_of(fisheye(math.radians(95)), 30.0)
FTHETA_OF_ANGLE = replace(
    camera_of(RadialLens(RisingCurve((0.0, 31.0, 0.5, -0.8), 1.7), True, 1.7), 1.0),
    pixels_per_unit=(1.0, 0.002, -0.001, 1.0),
)
FTHETA_OF_DISTANCE = replace(
    camera_of(RadialLens(RisingCurve((0.0, 0.03, 1e-5, 2e-7), 200.0), False, 1.6), 1.0),
    pixels_per_unit=(1.02, 0.0, 0.0, 1.0),
)
GLASS = Windshield(
    (0.001, 1.01, 0.02, 0.003, 0.01, -0.02), (0, 0.002, 0.01, 1.005, 0.003, 0.01), True
)
CAMERAS = {
    "pinhole": PINHOLE,
    "fisheye": FISHEYE,
    "f-theta of angle": FTHETA_OF_ANGLE,
    "f-theta of distance": FTHETA_OF_DISTANCE,
    "behind glass": replace(PINHOLE, windshield=GLASS),
    "fisheye behind glass": replace(FISHEYE, windshield=replace(GLASS, is_forward=False)),
}


def directions(reach):
    random = np.random.default_rng(0)
    return np.concatenate([random.uniform(-reach, reach, (200, 2)), np.ones((200, 1))], axis=1)


def test_pinhole_projects_as_opencv_does():
    points = directions(0.8)
    k1, k2, k3, *rest = RADIAL
    terms = np.array([k1, k2, *TANGENTIAL, k3, *rest, *PRISM])
    matrix = np.array([[100, 0, 47], [0, 101, 28.5], [0, 0, 1.0]])
    expected = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, terms)[0][:, 0]
    assert np.abs(PINHOLE.project(torch.from_numpy(points)).numpy() - expected).max() < 1e-9


def test_fisheye_projects_as_opencv_does():
    points = directions(5.0)
    matrix = np.array([[30, 0, 47], [0, 30.3, 28.5], [0, 0, 1.0]])
    expected = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(KANNALA)
    )[0][:, 0]
    assert np.abs(FISHEYE.project(torch.from_numpy(points)).numpy() - expected).max() < 1e-9


def test_a_fisheye_sees_behind_its_own_plane():
    curve = RisingCurve((0.0, 1.0), math.radians(100))
    lens = RadialLens(curve, is_of_angle=True, max_angle_rad=math.radians(100))
    rays, is_seen = camera_of(lens, 27.0).pixel_rays()
    angle = torch.rad2deg(torch.arccos(rays[28, :, 2]))
    across = (torch.arange(WIDTH_PX) + 0.5 - 47.0) / 27.0
    expected = torch.rad2deg(across.abs()).double()
    shown = is_seen[28]
    assert bool((angle[shown] > 90).any())
    assert torch.allclose(angle[shown], expected[shown], atol=1e-9)
    assert bool((expected[~shown] > 99.9).all())


def test_ftheta_follows_its_polynomial():
    angle = 0.7
    seen = torch.tensor([[math.sin(angle), 0.0, math.cos(angle)]], dtype=torch.float64)
    distance = 31.0 * angle + 0.5 * angle**2 - 0.8 * angle**3
    expected = torch.tensor([[47.0 + distance, 28.5 - 0.001 * distance]], dtype=torch.float64)
    assert torch.allclose(FTHETA_OF_ANGLE.project(seen), expected)


def test_ftheta_by_distance_has_the_angle_of_its_polynomial():
    rays, _ = FTHETA_OF_DISTANCE.pixel_rays()
    distance = math.hypot((90.5 - 47.0) / 1.02, 10.5 - 28.5)
    angle = 0.03 * distance + 1e-5 * distance**2 + 2e-7 * distance**3
    assert math.acos(float(rays[10, 90, 2])) == pytest.approx(angle, abs=1e-9)


@pytest.mark.parametrize("name", CAMERAS)
def test_every_ray_falls_on_its_own_pixel(name):
    camera = CAMERAS[name]
    rays, is_seen = camera.pixel_rays()
    grid = torch.stack(
        torch.meshgrid(torch.arange(WIDTH_PX), torch.arange(HEIGHT_PX), indexing="xy"), dim=-1
    )
    missed = (camera.project(rays) - grid - 0.5).norm(dim=-1)
    assert is_seen.float().mean() > 0.75
    assert float(missed[is_seen].max()) < 1e-3


def test_glass_that_is_told_backwards_undoes_itself():
    rays = torch.nn.functional.normalize(torch.from_numpy(directions(0.6)), dim=-1)
    backwards = replace(GLASS, is_forward=False)
    assert torch.allclose(GLASS.at_lens(rays), backwards.in_world(rays))
    assert torch.allclose(GLASS.in_world(GLASS.at_lens(rays)), rays, atol=1e-10)


def test_a_polynomial_counts_as_far_as_it_rises():
    curve = RisingCurve((0.0, 1.0, 0.0, -1.0), 2.0)  # rises up to 1 / sqrt(3)
    assert curve.end == pytest.approx(1 / math.sqrt(3), abs=2e-3)
    highest = curve.at(torch.tensor([5.0], dtype=torch.float64))
    assert float(curve.back(highest)) == pytest.approx(curve.end, abs=1e-3)


def test_a_smaller_image_sees_the_same():
    small = PINHOLE.resized(48, 27)
    points = torch.from_numpy(directions(0.3))
    assert torch.allclose(small.project(points) * 2, PINHOLE.project(points))


@pytest.mark.parametrize("name", CAMERAS)
def test_places_of_points_have_their_slope(name):
    """By which a rolling shutter stretches what it reads."""
    camera = CAMERAS[name]
    points = torch.tensor([[0.4, -0.2, 2.0], [-0.1, 0.3, 1.0]], dtype=torch.float64)
    points.requires_grad_()
    (slope,) = torch.autograd.grad(camera.project(points).sum(), points)
    step = 1e-5 * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    with torch.no_grad():
        apart = camera.project(points + step) - camera.project(points - step)
    assert torch.allclose(slope[:, 0], apart.sum(dim=1) / 2e-5, rtol=1e-4)
