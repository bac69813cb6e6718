"""What holds for every style: identity at no strength, one image per seed, displayable light."""

import pytest
import torch

from lidarpainter_models.errors import ConfigError, ShapeError
from lidarpainter_models.painter.styles import STYLE_PROMPTS, apply_style
from lidarpainter_models.painter.styles.fog import add_fog
from lidarpainter_models.painter.styles.night import turn_to_night
from lidarpainter_models.painter.styles.rain import add_rain
from lidarpainter_models.painter.styles.view import (
    StyleView,
    distances,
    fit_ground,
    open_sky,
    surface_points,
)
from lidarpainter_models.weather.light import to_display, to_linear

NO_STRENGTH = {
    "foggy": lambda view: add_fog(view, 1e12),
    "night": lambda view: turn_to_night(view, generator_of(0), 0),
    "rain": lambda view: add_rain(view, generator_of(0), 0),
}
STYLES = STYLE_PROMPTS[1:]


def generator_of(seed):
    return torch.Generator().manual_seed(seed)


def test_light_is_the_curve_of_srgb_and_back():
    shown = torch.linspace(0, 1, 256)[:, None].expand(-1, 3)
    torch.testing.assert_close(to_display(to_linear(shown)), shown, atol=1e-6, rtol=0)
    grey = to_linear(torch.full((1, 3), 0.5))
    assert float(grey[0, 0]) == pytest.approx(0.21404, abs=1e-5)  # ((0.5 + 0.055) / 1.055)^2.4


@pytest.mark.parametrize("prompt", STYLES)
def test_a_style_without_strength_changes_nothing(street, prompt):
    styled = NO_STRENGTH[prompt](street)
    torch.testing.assert_close(styled, street.rgb, atol=1e-5, rtol=0)  # of the display curve


@pytest.mark.parametrize("prompt", STYLES)
def test_a_style_changes_the_image_and_stays_displayable(street, prompt):
    styled = apply_style(street, prompt, generator_of(0))
    assert styled.shape == street.rgb.shape
    assert bool(((styled >= 0) & (styled <= 1)).all())  # which NaN is not
    assert float((styled - street.rgb).abs().mean()) > 0.05


@pytest.mark.parametrize("prompt", STYLES)
def test_a_seed_alone_decides_the_image(street, prompt):
    before = torch.get_rng_state()
    first, again, other = (apply_style(street, prompt, generator_of(s)) for s in (1, 1, 2))
    assert torch.equal(first, again)
    assert torch.equal(first, other) is (prompt == "foggy")  # fog draws nothing
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("prompt", STYLES)
def test_a_style_works_without_a_camera_and_without_depth(street_without_camera, prompt):
    view = street_without_camera
    bare = StyleView(rgb=view.rgb, depth_m=torch.zeros_like(view.depth_m), sky=view.sky)
    for one in (view, bare):
        styled = apply_style(one, prompt, generator_of(0))
        assert bool(((styled >= 0) & (styled <= 1)).all())


def test_an_unknown_style_is_one_clear_line(street):
    with pytest.raises(ConfigError, match="no style 'snow', expected clear, foggy, night, rain"):
        apply_style(street, "snow", generator_of(0))


def test_maps_of_another_size_are_refused(street):
    with pytest.raises(ShapeError, match="one size"):
        StyleView(rgb=street.rgb, depth_m=torch.zeros(4, 4), sky=street.sky)


def test_gaps_in_depth_take_the_distance_around_them(street):
    depth_m = street.depth_m.clone()
    depth_m[70:74, 60:70] = 0
    holed = StyleView(rgb=street.rgb, depth_m=depth_m, sky=street.sky, camera=street.camera)
    torch.testing.assert_close(distances(holed), distances(street), rtol=0.12, atol=0.01)


def test_the_ground_plane_is_where_the_road_lies(street):
    points_m = surface_points(street.camera, distances(street))
    ground = fit_ground(points_m, street.surface)
    assert ground.camera_height_m == pytest.approx(1.6, abs=0.01)
    assert abs(float(ground.heights(points_m)[85, 80])) < 0.01
    noisy = points_m * (1 + 0.02 * torch.randn(90, 160, 1, generator=generator_of(0)))
    flat = ground.heights(ground.flattened(noisy))[75:, 40:120]
    assert float(flat.abs().max()) < 0.02


def test_a_view_without_ground_has_no_ground_plane(street):
    points_m = surface_points(street.camera, distances(street))
    assert fit_ground(points_m, torch.zeros_like(street.surface)) is None
    assert fit_ground(points_m + torch.tensor([0, 0, 1.5]), street.surface) is None


def test_the_rim_of_the_sky_is_sky_as_far_as_it_is_as_bright(street):
    row = int(street.sky[:, 80].sum())
    sky = street.sky.clone()
    sky[row - 2 : row] = 0  # the mask stops two pixels short of the wall
    view = StyleView(rgb=street.rgb, depth_m=street.depth_m, sky=sky, camera=street.camera)
    found = open_sky(view)
    assert float(found[row - 1, 80]) > 0.5
    assert float(found[row + 12 :, 80].max()) == 0
