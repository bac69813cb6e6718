"""Fog obeys Koschmieder's law."""

from dataclasses import replace
from math import exp, log

import pytest
import torch

from lidarpainter_models.painter.styles.fog import add_fog, airlight, fog_transmittance
from lidarpainter_models.painter.styles.view import StyleView, distances
from lidarpainter_models.weather.air import FOG_BRIGHTNESS, FOG_GREYNESS, FOG_LAYER_M
from lidarpainter_models.weather.light import luminance, to_linear


def test_light_is_that_of_the_law_in_every_surface_pixel(street):
    through = torch.exp(-log(50) / 80 * distances(street))[..., None]
    air = FOG_BRIGHTNESS * airlight(street, greyness=FOG_GREYNESS)
    expected = to_linear(street.rgb) * through + air * (1 - through)
    found = to_linear(add_fog(street, 80.0))
    torch.testing.assert_close(found[street.surface], expected[street.surface], atol=1e-5, rtol=0)


def test_the_zenith_is_seen_through_less_fog_than_the_horizon(street):
    through = fog_transmittance(street, 400.0)
    sky = through[:, 80][street.sky[:, 80] > 0]
    assert bool((sky[1:] <= sky[:-1]).all())
    angle = torch.atan2(torch.tensor(44.5), torch.tensor((0.5**2 + 120.0**2) ** 0.5))
    expected = exp(-log(50) / 400 * FOG_LAYER_M / float(angle.sin()))
    assert float(sky[0]) == pytest.approx(expected, rel=1e-3)


def test_the_airlight_is_that_of_the_horizon(street):
    rgb = street.rgb.clone()
    rgb[:10] = torch.tensor([0.1, 0.1, 0.9])  # the zenith is bluer
    expected = to_linear(torch.tensor([0.62, 0.74, 0.9]))
    found = airlight(replace(street, rgb=rgb), greyness=0.0)
    torch.testing.assert_close(found, expected)
    grey = airlight(replace(street, rgb=rgb), greyness=1.0)
    torch.testing.assert_close(grey, luminance(expected).expand(3))


def test_without_sky_the_haziest_far_surface_stands_for_the_horizon():
    rgb, depth_m = torch.full((20, 20, 3), 0.2), torch.full((20, 20), 5.0)
    depth_m[:4], rgb[:4] = 80.0, torch.tensor([0.7, 0.72, 0.74])
    rgb[0, :5] = torch.tensor([1.0, 0.0, 0.0])  # bright, but no haze
    rgb[10] = 1.0  # bright, but near
    view = StyleView(rgb=rgb, depth_m=depth_m, sky=torch.zeros(20, 20))
    found = airlight(view, greyness=0.0)
    torch.testing.assert_close(found, to_linear(torch.tensor([0.7, 0.72, 0.74])))


def test_a_pixel_at_an_edge_mixes_surface_and_sky(street):
    half = replace(street, sky=torch.full_like(street.sky, 0.4))
    through = fog_transmittance(half, 100.0)
    full = fog_transmittance(replace(street, sky=torch.zeros_like(street.sky)), 100.0)
    sky = fog_transmittance(replace(street, sky=torch.ones_like(street.sky)), 100.0)
    known = street.depth_m > 0
    torch.testing.assert_close(through[known], (0.4 * sky + 0.6 * full)[known])
