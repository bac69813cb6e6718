"""Colours of points: the numba loops against plain torch in double."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.cameras import READ_ROUNDS, Camera, Shutter
from lidarpainter_models.kernels.colour_sampling import (
    READ_MARGIN,
    SLOTS,
    BestSamples,
    combine_samples,
    in_any_image,
    insert_samples,
    project_inside,
    read_inside,
    sample_levels,
    steps_inside,
)

BACKENDS = ["cpu", "reference"]
EPS = np.finfo(np.float32).eps


def rng(seed=0):
    return np.random.default_rng(seed)


@pytest.mark.parametrize("count", [0, 1, 2000])
def test_the_same_points_fall_into_the_image(count):
    xyz_m = rng().uniform(-10, 10, (count, 3)).astype(np.float32)
    lens = np.array([[40.0, 0, 32, 0], [0, 40, 24, 0], [0, 0, 1, 0.5]])
    points, matrix = torch.from_numpy(xyz_m), torch.from_numpy(lens)
    fast, plain = (
        [found.numpy() for found in project_inside(points, matrix, 64, 48, 0.5, backend=name)]
        for name in BACKENDS
    )
    assert np.array_equal(fast[0], plain[0])  # a selection, none on an edge
    # sums of terms up to focal length times 10 m over at least half a metre of depth
    assert np.abs(fast[1] - plain[1]).max(initial=0) <= 4 * EPS * (40 * 10 / 0.5)
    assert np.abs(fast[2] - plain[2]).max(initial=0) <= 4 * EPS * 10.5


def turning_camera(yaw_rad=0.0):
    """At 20 m/s, turning, read from the top to the bottom within 30 ms."""
    twist = torch.tensor([0.02, -0.3, 0.05, 0.5, 0.1, 20.0])
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = pose[2, 2] = math.cos(yaw_rad)
    pose[0, 2], pose[2, 0] = math.sin(yaw_rad), -math.sin(yaw_rad)
    camera = Camera.centred(pose, 40.0, width_px=64, height_px=48)
    return replace(camera, shutter=Shutter(across_s=(0.002, 0.03), twist_per_s=twist))


@pytest.mark.parametrize("margin_px", [0, 5])
@pytest.mark.parametrize("backend", BACKENDS)
def test_what_a_rolling_shutter_reads_is_where_its_camera_projects_it(backend, margin_px):
    camera = turning_camera(0.2)
    points = torch.from_numpy(rng(3).uniform(-30, 30, (4000, 3)).astype(np.float32))
    found = read_inside(points, camera.packed(), margin_px, 0.5, READ_ROUNDS, backend=backend)
    rows, pixels_uv, depth_m = found
    at_uv, at_m = camera.project(points.double())
    assert 100 < len(rows) < 4000
    assert pixels_uv.numpy() == pytest.approx((at_uv[rows] + margin_px).numpy(), abs=1e-3)
    assert depth_m.numpy() == pytest.approx(at_m[rows].numpy(), rel=1e-5)
    inside = ((at_uv >= -margin_px) & (at_uv < torch.tensor([64, 48]) + margin_px)).all(dim=1)
    middle_uv, middle_m = replace(camera, shutter=None).project(points.double())
    # what is so near that it crosses a quarter of the image meanwhile is left out
    size = torch.tensor([64, 48]) + 2 * margin_px
    near = (((middle_uv + margin_px) / size - 0.5).abs() <= 0.5 + READ_MARGIN).all(dim=1)
    expected = inside & near & (middle_m >= 0.5) & (at_m > 0.5)
    assert rows.tolist() == expected.nonzero()[:, 0].tolist()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_point_is_in_any_image_that_reads_it(backend):
    cameras = [turning_camera(yaw) for yaw in (0.0, 1.5)] + [
        replace(turning_camera(3), shutter=None)
    ]
    points = torch.from_numpy(rng(4).uniform(-30, 30, (3000, 3)).astype(np.float32))
    packed = torch.stack([camera.packed() for camera in cameras])
    found = in_any_image(points, packed, 0.1, READ_ROUNDS, backend=backend)
    seen = [camera.contains(*camera.project(points.double())) for camera in cameras]
    assert 0.1 < float(found.float().mean()) < 0.9
    assert torch.equal(found, torch.stack(seen).any(dim=0))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("axis", [0, 1])
def test_a_point_that_rounds_up_to_the_far_edge_is_outside(backend, axis):
    pixels_from_points = torch.zeros(3, 4, dtype=torch.float64)
    pixels_from_points[:, 3] = torch.tensor([2.0, 2.0, 1.0])
    pixels_from_points[axis, 3] = 64 - 1e-9
    points, sizes = torch.zeros(1, 3), [64, 64]
    rows, _, _ = project_inside(points, pixels_from_points, *sizes, 0.5, backend=backend)
    assert rows.tolist() == []
    pixels_from_points[axis, 3] = 64 - 1e-5
    _, pixels_uv, _ = project_inside(points, pixels_from_points, *sizes, 0.5, backend=backend)
    assert int(pixels_uv[0, axis]) == 63


def test_the_same_samples_are_kept():
    slots = []
    for backend in BACKENDS:
        generator = rng(1)
        kept = BestSamples.none_yet(300, 9)
        for view in range(9):
            rows = generator.permutation(300)[:200]
            # few different weights, so that equal ones meet
            weight = generator.integers(1, 5, 200).astype(np.float32)
            rgb = generator.integers(0, 256, (200, 3), dtype=np.uint8)
            insert_samples(kept, rows, weight, rgb, view, backend=backend)
        slots.append(kept)
    for fast, plain in zip(*slots, strict=True):
        assert np.array_equal(fast, plain)
    assert bool((np.diff(slots[0].weight, axis=1) <= 0).all())


@pytest.mark.parametrize("backend", BACKENDS)
def test_samples_of_very_many_views_keep_their_views(backend):
    kept = BestSamples.none_yet(1, 70_000)
    weight, rgb = np.ones(1, np.float32), np.zeros((1, 3), np.uint8)
    insert_samples(kept, np.zeros(1, np.int64), weight, rgb, 69_999, backend=backend)
    assert kept.view[0, 0] == 69_999


def test_the_same_inner_cells_are_found():
    generator = rng(2)
    inner_m = generator.choice([5.0, 8.0, np.inf], (30, 40), p=[0.1, 0.1, 0.8]).astype(np.float32)
    cells_uv = np.stack([generator.integers(0, 40, 500), generator.integers(0, 30, 500)], axis=1)
    depth_m = generator.choice([5.1, 8.1], 500).astype(np.float32)
    fast, plain = (steps_inside(cells_uv, depth_m, inner_m, 3, 0.05, backend=b) for b in BACKENDS)
    assert np.array_equal(fast[1], plain[1])
    assert np.array_equal(fast[0], plain[0])
    assert 0 < fast[1].sum() < 500


def test_samples_of_a_pyramid_are_rounded_alike():
    generator = rng(3)
    images = [generator.integers(0, 256, (48 // n, 64 // n, 3), dtype=np.uint8) for n in (1, 2, 4)]
    pixels_uv = generator.uniform(-1, 65, (800, 2)).astype(np.float32)
    level = generator.integers(0, 3, 800, dtype=np.int32)
    fast, plain = (sample_levels(pixels_uv, level, *images, backend=b) for b in BACKENDS)
    assert np.abs(fast.astype(int) - plain).max() <= 1  # either side of a half
    assert np.mean(fast != plain) < 0.01


def test_combined_colours_are_rounded_alike():
    generator = rng(4)
    weight = -np.sort(-generator.uniform(0.1, 1, (500, SLOTS)).astype(np.float32), axis=1)
    used = generator.integers(0, SLOTS + 1, 500)
    weight[np.arange(SLOTS) >= used[:, None]] = 0
    rgb = generator.integers(60, 130, (500, SLOTS, 3), dtype=np.uint8)
    view = generator.integers(0, 7, (500, SLOTS)).astype(np.int16)
    gain = generator.uniform(0.8, 1.2, (7, 3)).astype(np.float32)
    fast, plain = (
        combine_samples(BestSamples(weight, rgb, view), gain, backend=b) for b in BACKENDS
    )
    assert np.array_equal(fast[1], plain[1])
    assert np.array_equal(fast[1], used > 0)
    assert np.abs(fast[0].astype(int) - plain[0]).max() <= 1  # either side of a half
    assert np.mean(fast[0] != plain[0]) < 0.01


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_outlier_of_three_samples_is_left_out_by_hand(backend):
    weight = np.array([[1.0, 1.0, 1.0, 0.0]], np.float32)
    rgb = np.array([[[100] * 3, [110] * 3, [250] * 3, [0] * 3]], np.uint8)
    view, gain = np.zeros((1, SLOTS), np.int16), np.ones((1, 3), np.float32)
    colour, has_colour = combine_samples(BestSamples(weight, rgb, view), gain, backend=backend)
    assert colour.tolist() == [[105] * 3]
    assert has_colour.tolist() == [True]


def test_what_does_not_belong_together_is_refused():
    nothing = np.zeros((3, SLOTS), np.float32)
    with pytest.raises(ShapeError, match="points"):
        project_inside(torch.zeros(3, 2), torch.eye(3, 4), 4, 4, 0.1)
    with pytest.raises(ShapeError, match="slots differ"):
        combine_samples(
            BestSamples(nothing, np.zeros((3, 2, 3), np.uint8), nothing), np.ones((1, 3))
        )
    with pytest.raises(ShapeError, match="a cell each"):
        steps_inside(np.zeros((2, 2), int), np.zeros(3), np.zeros((4, 4)), 1, 0.1)
