from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_street import BLUE, CAR_X_M, GREEN, GROUND, RED, WALL_X_M, ToyStreet

from lidarpainter_models.kernels.colour_sampling import BestSamples
from lidarpainter_models.lidar import map_building, points_in_view
from lidarpainter_models.lidar.colouring import MapColouring
from lidarpainter_models.lidar.exposure_matching import match_exposure
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.lidar.map_building import build_lidar_map
from lidarpainter_models.lidar.points_in_view import MOST_AGE_NS, Body

FRAMES = (0, 1, 2, 3)


@pytest.fixture(scope="module")
def coloured():
    street = ToyStreet()
    return build_lidar_map(street, split_frames=FRAMES, colour_views=street.views)


def distance(rgb_u8, colour):
    return (rgb_u8.float() - torch.tensor(colour)).abs().amax(dim=-1)


def test_every_surface_takes_its_colour(coloured):
    street = coloured.street
    assert float(street.has_colour.float().mean()) > 0.9
    seen = street.keep(street.has_colour)
    x, y, z = seen.xyz_m.unbind(-1)
    is_wall = (x - WALL_X_M).abs() < 0.01
    inner = is_wall & (z > 0.5) & (z < 5.5)
    assert float((distance(seen.rgb_u8[inner & (y > 0.3)], RED) < 12).float().mean()) > 0.97
    assert float((distance(seen.rgb_u8[inner & (y < -0.3)], BLUE) < 12).float().mean()) > 0.97
    assert float((distance(seen.rgb_u8[~is_wall & (x < 19)], GROUND) < 12).float().mean()) > 0.97


def test_a_car_does_not_colour_what_is_behind_it(coloured):
    seen = coloured.street.keep(coloured.street.has_colour)
    behind = seen.xyz_m[:, 0] > CAR_X_M
    assert float((distance(seen.rgb_u8[behind], GREEN) < 40).float().mean()) < 0.002


def test_a_moving_car_takes_its_own_colour(coloured):
    car = coloured.actors["car"]
    seen = car.keep(car.has_colour)
    assert len(seen) > 0.9 * len(car)
    assert float((distance(seen.rgb_u8, GREEN) < 12).float().mean()) > 0.95


def test_only_the_given_images_give_colours():
    street = ToyStreet()
    bare = build_lidar_map(street, split_frames=FRAMES, colour_views=())
    assert not bare.street.has_colour.any()
    assert not bare.street.rgb_u8.any()
    read = []
    street.read_image = lambda view: read.append(view.key) or ToyStreet.read_image(street, view)
    build_lidar_map(street, split_frames=FRAMES, colour_views=street.views[1:2])
    assert read == [(1, "front")]


def test_points_that_have_better_samples_are_not_asked_again(monkeypatch):
    street = ToyStreet(camera_gains=(("front", 1.0), ("dim", 0.7)))
    asked, may_gain = [], MapColouring._may_gain

    def everything(colouring, inside, camera):
        asked.append((len(may_gain(colouring, inside, camera)), len(inside)))
        return torch.arange(len(inside))

    found = build_lidar_map(street, split_frames=FRAMES, colour_views=street.views)
    monkeypatch.setattr(MapColouring, "_may_gain", everything)
    of_all = build_lidar_map(street, split_frames=FRAMES, colour_views=street.views)
    assert torch.equal(found.street.rgb_u8, of_all.street.rgb_u8)
    assert torch.equal(found.street.has_colour, of_all.street.has_colour)
    assert sum(few for few, _ in asked) < 0.9 * sum(every for _, every in asked)


def test_pieces_of_the_map_change_no_bit(coloured, monkeypatch):
    monkeypatch.setattr(points_in_view, "POINTS_AT_ONCE", 1000)
    street = ToyStreet()
    pieces = build_lidar_map(street, split_frames=FRAMES, colour_views=street.views)
    assert len(pieces.street) > 3000
    for ours, whole in (
        (pieces.street, coloured.street),
        (pieces.actors["car"], coloured.actors["car"]),
    ):
        assert torch.equal(ours.rgb_u8, whole.rgb_u8)
        assert torch.equal(ours.has_colour, whole.has_colour)


@pytest.mark.parametrize("way", [-1, 1])
def test_images_long_before_or_after_a_sweep_are_not_asked_for_the_street(way):
    street = ToyStreet()
    for age_ns, are_asked in ((MOST_AGE_NS - 10**9, True), (MOST_AGE_NS + 10**9, False)):
        shift_ns = way * age_ns
        moved = [replace(view, timestamp_ns=view.timestamp_ns + shift_ns) for view in street.views]
        points = build_lidar_map(street, split_frames=FRAMES, colour_views=moved).street
        assert bool(points.has_colour.any()) == are_asked


def test_the_stretches_about_a_time_hold_the_sweeps_measured_then():
    frame = torch.tensor([0, 0, 3, 6, 6, 9, 0, 3, 9])  # near points come after all others
    points = MapPoints.uncoloured(
        xyz_m=torch.zeros(len(frame), 3),
        frame_index=frame,
        timestamp_ns=frame * MOST_AGE_NS // 3 - torch.tensor([0, 9, 0, 0, 0, 0, 0, 0, 0]),
        range_m=torch.ones(len(frame)),
    )
    body = Body(None, points, MOST_AGE_NS)
    assert body.stretches_about(0) == [slice(0, 3), slice(6, 8)]
    assert body.stretches_about(MOST_AGE_NS) == [slice(0, 5), slice(6, 8)]
    assert body.stretches_about(MOST_AGE_NS + 1) == [slice(2, 5), slice(7, 8)]
    assert body.stretches_about(2 * MOST_AGE_NS) == [slice(2, 6), slice(7, 9)]
    assert body.stretches_about(10 * MOST_AGE_NS) == []
    assert Body(None, points.keep(frame < 0), MOST_AGE_NS).stretches_about(0) == []
    assert Body(None, points).stretches_about(10 * MOST_AGE_NS) == [slice(0, 9)]


def test_cameras_are_brought_to_the_exposure_of_the_first(monkeypatch):
    monkeypatch.setattr(map_building, "LEAST_WAY_M", 0.0)  # the street stands
    street = ToyStreet(camera_gains=(("front", 1.0), ("dim", 0.7)))
    # the dim camera alone sees frames 2 and 3
    views = [v for v in street.views if v.camera_name == "dim" or v.frame_index < 2]
    views.sort(key=lambda view: view.camera_name == "dim")
    points = build_lidar_map(street, split_frames=FRAMES, colour_views=views).street
    ground = points.has_colour & (points.xyz_m[:, 0] < 9) & (points.frame_index == 3)
    assert int(ground.sum()) > 100
    assert float(distance(points.rgb_u8[ground], GROUND).median()) < 4


def test_an_exposure_jump_of_one_view_is_found():
    generator = np.random.default_rng(0)
    points, gains = 2000, np.array([1.0, 1.0, 0.8, 1.0])
    true = generator.uniform(60, 180, (points, 1, 3))
    view = np.stack([generator.permutation(4)[:3] for _ in range(points)])
    noisy = true * gains[view][..., None] * generator.normal(1, 0.03, (points, 3, 3))
    noisy[::11] = 230  # outliers
    samples = BestSamples(np.ones((points, 3), np.float32), noisy.astype(np.uint8), view)
    found = match_exposure(samples, np.zeros(4, int))
    np.testing.assert_allclose(found[2], 1.25, rtol=0.03)
    np.testing.assert_allclose(found[[0, 1, 3]], 1.0, rtol=0.01)


def test_an_exposure_jump_is_found_in_a_long_log():
    views, points = 3000, 350_000
    generator = np.random.default_rng(1)
    first = generator.integers(0, views - 1, points)
    view = np.stack([first, first + 1], axis=1)
    gains = np.ones(views)
    gains[1500] = 0.8
    rgb = np.repeat((120 * gains[view])[..., None], 3, axis=2).round().astype(np.uint8)
    samples = BestSamples(np.ones((points, 2), np.float32), rgb, view)
    found = match_exposure(samples, np.zeros(views, int))
    np.testing.assert_allclose(found[1500], 1.25, rtol=0.03)
    np.testing.assert_allclose(np.delete(found, 1500, axis=0), 1, rtol=0.01)


def test_a_camera_without_shared_points_keeps_its_exposure():
    weight = np.ones((500, 2), np.float32)
    rgb = np.full((500, 2, 3), 100, np.uint8)
    view = np.repeat(np.array([[0, 1], [2, 3]]), 250, axis=0)
    gains = match_exposure(BestSamples(weight, rgb, view), np.array([0, 0, 1, 1]))
    np.testing.assert_array_equal(gains, 1)
