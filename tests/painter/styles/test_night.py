"""Night: dark where nothing shines, lamps where they were seen, light that is conserved."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.painter.styles import night
from lidarpainter_models.painter.styles.lamps import Place, find_lamps
from lidarpainter_models.painter.styles.night import (
    add_glare,
    lamp_irradiance,
    low_beam,
    turn_to_night,
)
from lidarpainter_models.painter.styles.view import distances, fit_ground, surface_points
from lidarpainter_models.weather.light import luminance, to_linear


@pytest.fixture
def _dark(monkeypatch):
    """No beam, no window lit, no noise."""
    for name in ("BEAM", "LIT_SHARE", "NOISE"):
        monkeypatch.setattr(night, name, 0)


def generator_of(seed=0):
    return torch.Generator().manual_seed(seed)


def place_of(view):
    distance_m = distances(view)
    points_m = surface_points(view.camera, distance_m)
    place = Place(
        light=to_linear(view.rgb),
        display=view.rgb,
        distance_m=distance_m,
        height_m=fit_ground(points_m, view.surface).heights(points_m),
        surface=view.surface,
        focal_px=view.focal_px,
    )
    return place, points_m


@pytest.fixture(scope="module")
def street_with_tail_light(street):
    """A red lamp of 0.3 m on the wall across the end of the road is too small; this one is near."""
    rgb = street.rgb.clone()
    rgb[52:55, 20:23] = torch.tensor([0.7, 0.1, 0.12])
    return replace(street, rgb=rgb)


def brightness(rgb):
    return luminance(to_linear(rgb))


@pytest.mark.usefixtures("_dark")
def test_night_is_dark_and_its_sky_darker_than_by_day(street):
    found = brightness(turn_to_night(street, generator_of()))
    assert float(found.mean()) < 0.15 * float(brightness(street.rgb).mean())
    assert float(found[street.sky > 0].max()) < 0.1


@pytest.mark.usefixtures("_dark")
def test_skylight_turns_colours_blue(street):
    found = to_linear(turn_to_night(street, generator_of()))[street.surface].mean(dim=0)
    day = to_linear(street.rgb)[street.surface].mean(dim=0)
    assert float(found[2] / found[0]) > 1.5 * float(day[2] / day[0])


@pytest.mark.usefixtures("_dark")
def test_a_red_patch_of_the_size_of_a_tail_light_shines(street_with_tail_light):
    place, _ = place_of(street_with_tail_light)
    lamps = find_lamps(place, lit_share=0.0, generator=generator_of())
    assert [(lamp.kind, lamp.top_px, lamp.left_px) for lamp in lamps] == [("signal", 52, 20)]
    red, green, _ = to_linear(turn_to_night(street_with_tail_light, generator_of()))[53, 21]
    assert float(red) > 0.5
    assert float(red) > 5 * float(green)


@pytest.mark.parametrize("colour", [(0.7, 0.6, 0.6), (0.15, 0.02, 0.02)])
def test_pale_and_dark_patches_do_not_shine(street, colour):
    rgb = street.rgb.clone()
    rgb[52:55, 20:23] = torch.tensor(colour)
    place, _ = place_of(replace(street, rgb=rgb))
    assert find_lamps(place, lit_share=0.0, generator=generator_of()) == []


def test_a_red_wall_is_no_lamp(street):
    rgb = street.rgb.clone()
    rgb[30:60, :30] = torch.tensor([0.7, 0.1, 0.12])
    place, _ = place_of(replace(street, rgb=rgb))
    assert find_lamps(place, lit_share=0.0, generator=generator_of()) == []


def test_a_share_of_the_windows_is_lit(street):
    rgb = street.rgb.clone()
    for left in range(60, 100, 6):  # panes of 1.5 by 2 m in the wall across, at 60 m
        rgb[36:40, left : left + 3] = 0.1
    place, _ = place_of(replace(street, rgb=rgb))
    counts = [
        len(find_lamps(place, lit_share=share, generator=generator_of())) for share in (0, 0.5, 1)
    ]
    assert counts[0] == 0 < counts[1] < counts[2]
    lamps = find_lamps(place, lit_share=1.0, generator=generator_of())
    assert [lamp.kind for lamp in lamps] == ["window"] * 7
    for lamp in lamps:
        assert float(place.light[lamp.window][lamp.patch].mean()) < 0.02  # the dark panes


def test_a_lamp_on_a_pole_before_the_sky_is_a_street_lamp(street):
    rgb, depth_m, sky = street.rgb.clone(), street.depth_m.clone(), street.sky.clone()
    # at 12 m: a pole up to 5.6 m with an arm of 1 m
    for rows, columns in ((slice(4, 60), slice(80, 81)), (slice(4, 6), slice(80, 92))):
        rgb[rows, columns], depth_m[rows, columns], sky[rows, columns] = 0.2, 12.0, 0.0
    place, _ = place_of(replace(street, rgb=rgb, depth_m=depth_m, sky=sky))
    lamps = find_lamps(place, lit_share=0.0, generator=generator_of())
    assert [lamp.kind for lamp in lamps] == ["street"]
    assert lamps[0].left_px > 85  # the end of the arm, not the pole


def test_the_low_beam_lights_the_road_and_not_the_upper_walls(street):
    place, points_m = place_of(street)
    beam = luminance(low_beam(street.camera, points_m, place.height_m))
    assert float(beam[66, 80]) > 20 * float(beam[20, 20])
    ahead = beam[50:, 80]  # upwards ever farther
    assert float(ahead[0]) < float(ahead[20])
    assert float(beam[66, 80]) > float(beam[66, 40])  # less to the sides


def test_light_of_a_lamp_falls_with_the_square_of_distance(street_with_tail_light):
    place, points_m = place_of(street_with_tail_light)
    lamps = find_lamps(place, lit_share=0.0, generator=generator_of())
    found = lamp_irradiance(lamps, points_m, place)[..., 0]
    where = points_m[52:55, 20:23].reshape(-1, 3).median(dim=0).values
    squared = (points_m - where).square().sum(dim=-1)
    constant = (found * (squared + 2.0))[street_with_tail_light.surface]
    assert float(constant.std() / constant.mean()) < 1e-4


def test_glare_spreads_light_and_keeps_its_sum():
    light = torch.zeros(101, 101, 3)
    light[50, 50] = 30.0
    found = add_glare(light, focal_px=100.0)
    assert float(found.sum()) == pytest.approx(90.0, rel=2e-3)  # the widest tail leaves the image
    assert float(found[50, 50, 0]) < 29.0
    assert float(found[50, 55, 0]) > 0
    dim = torch.full((20, 20, 3), 0.4)
    assert torch.equal(add_glare(dim, focal_px=100.0), dim)


@pytest.mark.usefixtures("_dark")
def test_half_of_the_night_lies_between_day_and_night(street):
    day, whole = to_linear(street.rgb), to_linear(turn_to_night(street, generator_of()))
    half = to_linear(turn_to_night(street, generator_of(), 0.5))
    torch.testing.assert_close(half, (day + whole) / 2, atol=2e-3, rtol=0)
