"""Fog and rain in sweeps: what the air takes, and what it sends back by itself."""

import math

import pytest
import torch
from styled_world import place

from lidarpainter_models.gaussians.lidar_returns.weather import SEEN_FROM_M, Air
from lidarpainter_models.gaussians.model.styling.scene_style import SceneStyle
from lidarpainter_models.weather.mix import StyleMix
from lidarpainter_models.weather.water import DROPS_RETURN_M

RAYS = 20_000


def air(text, visibility_m=None):
    mix = StyleMix.parse(text, visibility_m=visibility_m)
    return Air.of(SceneStyle(mix=mix, seed=0, place=place()), 0)


def rays(value):
    return torch.full((RAYS,), float(value))


def drawn():
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("text", ["clear", "night", "foggy:0"])
def test_clear_air_and_night_change_nothing(text):
    assert air(text) is None
    assert Air.of(None, 0) is None


def test_fog_dims_by_the_way_there_and_back():
    told, lost = air("foggy", 100.0).dimmed(
        torch.tensor([10.0, 50.0]), rays(0.4)[:2], torch.zeros(2)
    )
    expected = [0.4 * math.exp(-2 * math.log(50) / 100 * range_m) for range_m in (10.0, 50.0)]
    assert told.tolist() == pytest.approx(expected, rel=1e-5)
    assert lost[0] < 0.05 < 0.5 < lost[1]


def test_what_was_lost_in_clear_air_stays_lost():
    _, lost = air("foggy:0.2+rain").dimmed(rays(15), rays(0.3), torch.linspace(0, 1, RAYS))
    assert bool((lost >= torch.linspace(0, 1, RAYS) - 1e-6).all())
    assert lost[-1] == 1


def test_fog_returns_near_the_sensor_and_more_so_the_denser_it_is():
    shares = []
    for visibility_m in (300.0, 100.0, 40.0):
        fog = air("foggy", visibility_m)
        at_m = fog.clutter_m(rays(25), rays(0.2), drawn())
        back = torch.isfinite(at_m)
        assert bool(((at_m[back] >= SEEN_FROM_M) & (at_m[back] <= 25)).all())
        shares.append(float(back.float().mean()))
    assert shares[0] < 0.1 < 0.5 < shares[2]
    assert shares == sorted(shares)


def test_fog_is_beaten_by_what_stands_near():
    fog = air("foggy", 40.0)
    assert torch.isfinite(fog.clutter_m(rays(6), rays(0.3), drawn())).float().mean() < 0.1
    assert torch.isfinite(fog.clutter_m(rays(60), rays(0.3), drawn())).float().mean() > 0.9
    assert torch.isfinite(fog.clutter_m(rays(torch.inf), rays(0), drawn())).float().mean() > 0.9


def test_drops_of_heavy_rain_stop_a_few_rays_in_a_hundred_before_the_surface():
    at_m = air("rain").clutter_m(rays(40), rays(0.5), drawn())
    back = torch.isfinite(at_m)
    assert back.float().mean() == pytest.approx(1 - math.exp(-0.0027 * DROPS_RETURN_M), rel=0.15)
    assert at_m[back].max() <= DROPS_RETURN_M
    assert at_m[back].std() > 2  # anywhere up to there
    assert torch.isfinite(air("rain").clutter_m(rays(40), rays(0.5), None)).sum() == 0
