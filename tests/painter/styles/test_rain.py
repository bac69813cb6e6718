"""Rain: dark wet surfaces, a road that mirrors, drops that fall as drops do."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.painter.styles import rain
from lidarpainter_models.painter.styles.rain import (
    add_rain,
    fall_speed_mps,
    ground_pixels,
    mirrored,
)
from lidarpainter_models.painter.styles.view import distances, fit_ground, surface_points
from lidarpainter_models.weather.air import rain_extinction_per_m
from lidarpainter_models.weather.light import luminance, to_linear
from lidarpainter_models.weather.water import fresnel, puddles, wet_reflectance


def generator_of(seed=0):
    return torch.Generator().manual_seed(seed)


def test_water_mirrors_two_percent_from_above_and_all_at_grazing():
    found = fresnel(torch.tensor([[1.0, 0.5, 0.0]]))[0].tolist()
    assert found[0] == pytest.approx(0.02)
    assert found[2] == pytest.approx(1.0)
    assert found[0] < found[1] < found[2]


def test_wet_surfaces_are_darker_and_more_colourful():
    dry = torch.tensor([[[0.4, 0.2, 0.1]]])
    wet = wet_reflectance(dry, 1.0)
    assert bool((wet < dry).all())
    assert float(wet[0, 0, 0] / wet[0, 0, 2]) > float(dry[0, 0, 0] / dry[0, 0, 2])
    assert torch.equal(wet_reflectance(dry, 0.0), dry)


def test_larger_drops_fall_faster_and_harder_rain_hides_more():
    speeds = fall_speed_mps(torch.tensor([1.0, 2.0, 4.0]))
    expected = torch.tensor([4.0, 6.55, 8.72])  # m/s, after Atlas et al.
    torch.testing.assert_close(speeds, expected, atol=0.01, rtol=0)
    assert rain_extinction_per_m(0.0) == 0
    assert rain_extinction_per_m(25.0) == pytest.approx(2.70e-3, rel=0.01)


def test_the_road_mirrors_the_wall_across_its_end(street):
    light = to_linear(street.rgb)
    green = torch.tensor([0.0, 0.5, 0.0])
    across = (street.depth_m - 60).abs() < 1e-3
    light[across] = green
    points_m = surface_points(street.camera, distances(street))
    ground = fit_ground(points_m, street.surface)
    share = ground_pixels(points_m, ground, street.surface)
    found = mirrored(light, torch.ones(3), street.camera, points_m, share > 0.5)
    # a wall seen k rows above the horizon is mirrored k rows below it
    top = int(across[:, 80].nonzero().min())
    assert 34 <= top <= 36  # 5.4 m above the eye, at 60 m
    torch.testing.assert_close(found[51, 80], green, atol=0.05, rtol=0)
    assert float(found[70, 80, 2]) > 0.5  # far below: the sky


def test_ground_is_the_road_and_nothing_else(street):
    points_m = surface_points(street.camera, distances(street))
    share = ground_pixels(points_m, fit_ground(points_m, street.surface), street.surface)
    assert float(share[80, 80]) == pytest.approx(1.0)
    assert float(share[20:40].max()) == 0


def test_puddles_cover_about_the_share_asked_for():
    grid = torch.stack(
        torch.meshgrid(torch.linspace(0, 60, 200), torch.linspace(-20, 20, 150), indexing="ij"), -1
    )
    points_m = torch.cat([grid, torch.zeros(200, 150, 1)], dim=-1)
    shares = [
        float(puddles(points_m, generator_of(), share=share).mean()) for share in (0.1, 0.4, 0.8)
    ]
    assert shares == sorted(shares)
    assert shares[1] == pytest.approx(0.4, abs=0.12)


def test_rain_hides_what_is_far_and_darkens_what_is_near(street, monkeypatch):
    monkeypatch.setattr(rain, "WETNESS", 0.0)
    found = []
    for rain_mm_per_h in (1e-6, 80.0):
        monkeypatch.setattr(rain, "RAIN_MM_PER_H", rain_mm_per_h)
        found.append(to_linear(add_rain(street, generator_of())))
    light, veiled = found
    near, far = (slice(80, 85), slice(70, 90)), (slice(38, 42), slice(76, 84))
    cloud = 0.45
    for place, least in ((near, 0.0), (far, 0.1)):
        gap = (luminance(light)[place].mean() - cloud).abs()
        left = (luminance(veiled)[place].mean() - cloud).abs()
        assert float(left) < (1 - least) * float(gap) + 0.01


def test_puddles_stay_where_they_are_from_view_to_view(street, monkeypatch):
    monkeypatch.setattr(rain, "fresnel", lambda cosine: torch.ones_like(cosine))
    monkeypatch.setattr(rain, "FILM_SHINE", 0.0)
    monkeypatch.setattr(rain, "STREAK_CONTRAST", 0.0)
    camera = street.camera
    pose = camera.world_from_camera.clone()
    pose[1, 3] -= 2.0
    aside = replace(street, camera=replace(camera, world_from_camera=pose))
    first, moved = (add_rain(view, generator_of()) for view in (street, aside))
    again = add_rain(street, generator_of(1))
    other = add_rain(street, generator_of(), place_seed=1)
    road = slice(70, 88), slice(60, 100)
    torch.testing.assert_close(again[road], first[road])
    assert float((other - first)[road].abs().mean()) > 0.02
    # the same picture from 2 m to the right shows other ground: its puddles are others
    assert float((moved - first)[road].abs().mean()) > 0.02
