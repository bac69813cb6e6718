"""What an image shows of points: numba against NumPy, and NumPy against differences."""

import cv2
import numpy as np
import pytest
from gaussian_world import camera_at

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.point_contrasts import (
    LATE,
    AssumedCamera,
    depths_before,
    seen_contrasts,
)

HEIGHT_PX, WIDTH_PX, COUNT = 90, 160, 300
TWIST = np.array([0.02, -0.1, 0.05, 1.0, -0.3, 15.0])
STEP = 1e-5
BACKENDS = ("cpu", "reference")
RECORDED = camera_at(0.0, width_px=WIDTH_PX, height_px=HEIGHT_PX)


def assumed(values=(0.0,) * 5, columns_s=0.0):
    """The camera turned, late and read by so much."""
    focal = RECORDED.fx_px
    return AssumedCamera(
        camera_from_world=RECORDED.camera_from_world.numpy(),
        twist_per_s=TWIST,
        turned_from_camera=cv2.Rodrigues(-np.array(values[:3]))[0],
        lens=np.array([focal, focal, RECORDED.cx_px, RECORDED.cy_px, WIDTH_PX, HEIGHT_PX]),
        late_s=float(values[LATE]),
        across_s=np.array([columns_s, float(values[4])]),
    )


def in_world(seen):
    pose = RECORDED.world_from_camera.numpy()
    return seen @ pose[:3, :3].T + pose[:3, 3]


def points_before(seed=0):
    draw = np.random.default_rng(seed)
    rays = np.stack([*draw.uniform(-0.6, 0.6, (2, COUNT)), np.ones(COUNT)], axis=1)
    return in_world(rays * draw.uniform(0.2, 40.0, (COUNT, 1)))


def ramp(axis):
    """Contrasts that are the pixel's own place along an axis, at every level."""
    rows, columns = np.mgrid[:HEIGHT_PX, :WIDTH_PX] + 0.5
    slopes = np.zeros((2, HEIGHT_PX, WIDTH_PX))
    slopes[axis] = 1.0
    image = np.stack([(columns, rows)[axis], *slopes], axis=-1).astype(np.float32)
    return np.stack([image] * 6)


FAR_M = np.full((HEIGHT_PX, WIDTH_PX), 1e6, np.float32)


@pytest.mark.parametrize("columns_s", [0.0, 0.02])
@pytest.mark.parametrize("level", [2, 3])
def test_both_backends_see_the_same(level, columns_s):
    draw, points = np.random.default_rng(1), points_before(2)
    levels = draw.normal(size=(6, HEIGHT_PX, WIDTH_PX, 3)).astype(np.float32)
    nearest_m = draw.uniform(0.0, 60.0, (HEIGHT_PX, WIDTH_PX)).astype(np.float32)
    camera = assumed((0.01, -0.02, 0.03, 0.04, -0.02), columns_s)
    hub_depth_m = 1.4 * depths_before(points, assumed(), backend="reference")
    fast, plain = (
        seen_contrasts(points, camera, levels, nearest_m, level, hub_depth_m, backend=backend)
        for backend in BACKENDS
    )
    assert 20 < fast.is_seen.sum() < COUNT
    for one, other in zip(fast, plain, strict=True):
        assert np.allclose(one, other, rtol=1e-9, atol=1e-9)
    depths = [depths_before(points, camera, backend=backend) for backend in BACKENDS]
    assert np.allclose(*depths, rtol=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("axis", [0, 1])
def test_slopes_are_the_differences_of_contrast(axis, backend):
    points = points_before()
    depth_m = depths_before(points, assumed(), backend=backend)

    def look(values):
        return seen_contrasts(
            points, assumed(values), ramp(axis), FAR_M, 2, depth_m, backend=backend
        )

    found = look(np.zeros(5))
    steps = STEP * np.eye(5)
    moved = [(look(step).contrast - look(-step).contrast) / (2 * STEP) for step in steps]
    assert found.is_seen.sum() > COUNT / 3
    slope, expected = found.slope[found.is_seen], np.stack(moved, axis=1)[found.is_seen]
    assert np.allclose(slope, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())
    scale = np.maximum(depth_m, 1)[:, None]
    assert np.allclose(found.motion[:, axis] / scale, found.slope)


@pytest.mark.parametrize("backend", BACKENDS)
def test_samples_are_linear_between_pixels_and_levels(backend):
    levels = np.zeros((2, HEIGHT_PX, WIDTH_PX, 3), np.float32)
    levels[1, 40, 50, 0] = 8.0
    pixels = np.array([[50.5, 40.5], [50.0, 40.5], [50.5, 40.0], [50.5, 40.5]])
    centre = np.array([RECORDED.cx_px, RECORDED.cy_px])
    rays = np.concatenate([(pixels - centre) / RECORDED.fx_px, np.ones((4, 1))], axis=1)
    points, hub_depth_m = in_world(10 * rays), np.array([14.1, 14.1, 14.1, 11.9])
    found = seen_contrasts(points, assumed(), levels, FAR_M, 0, hub_depth_m, backend=backend)
    assert found.contrast == pytest.approx([8.0, 4.0, 4.0, 4.0], abs=0.1)


def test_a_late_camera_has_driven_on():
    points = points_before()
    late = depths_before(points, assumed((0.0, 0.0, 0.0, 0.1, 0.0)))
    assert (late < depths_before(points, assumed())).all()


def test_what_stands_behind_a_return_is_not_seen():
    points, near_m = points_before(), np.full_like(FAR_M, 0.1)
    depth_m = depths_before(points, assumed())
    hidden = seen_contrasts(points, assumed(), ramp(0), near_m, 2, depth_m)
    assert not hidden.is_seen.any()
    assert not hidden.gradient.any()


def test_what_does_not_fit_is_refused():
    points = points_before()
    with pytest.raises(ShapeError, match="300 points need as many depths, got 2"):
        seen_contrasts(points, assumed(), ramp(0), FAR_M, 2, np.ones(2))
    with pytest.raises(ShapeError, match=r"contrasts of \(90, 160\) px"):
        seen_contrasts(points, assumed(), ramp(0), FAR_M[1:], 2, np.ones(COUNT))
