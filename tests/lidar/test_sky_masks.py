import pytest
import torch
from toy_street import EYE, LOOK_FORWARD, SKY, ToyStreet

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rigid_from_rotation
from lidarpainter_models.lidar.sky_masks import sky_from_returns, sky_mask
from lidarpainter_models.observations.image_shrinking import shrink_image

HEIGHT, WIDTH, HORIZON = 120, 200, 80


@pytest.fixture
def camera():
    return Camera(
        world_from_camera=rigid_from_rotation(LOOK_FORWARD, EYE).double(),
        fx_px=200,
        fy_px=200,
        cx_px=WIDTH / 2,
        cy_px=HORIZON,
        width_px=WIDTH,
        height_px=HEIGHT,
    )


def noise(shape, scale):
    return scale * torch.randn(shape, generator=torch.Generator().manual_seed(0))


def image_of(parts, *, sky=(170.0, 190.0, 215.0)):
    """A hazy sky over textured ground, and what is painted over them (rows, columns, rgb)."""
    rgb = torch.tensor(sky).expand(HEIGHT, WIDTH, 3).clone()
    rgb += torch.linspace(0, 30, HEIGHT)[:, None, None]
    rgb[HORIZON:] = 90.0
    rgb += noise(rgb.shape, 1.0)
    rgb[HORIZON:] += noise(rgb[HORIZON:].shape, 15.0)
    for rows, columns, colour, roughness in parts:
        rgb[rows, columns] = torch.tensor(colour) + noise(rgb[rows, columns].shape, roughness)
    return rgb.clamp(0, 255).to(torch.uint8)


def returns_in(*parts):
    """Every second row returns beams."""
    returns = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    returns[HORIZON + 4 :] = True
    for rows, columns in parts:
        returns[rows, columns] = True
    returns[::2] = False
    return returns


def test_open_sky_is_found_down_to_the_horizon(camera):
    sky = sky_from_returns(image_of([]), returns_in(), camera)
    assert not sky[HORIZON:].any()
    assert float(sky[: HORIZON - 4].float().mean()) > 0.97


def test_a_wall_above_the_highest_beam_is_not_sky(camera):
    # its colour is known from below, where beams return
    wall = (slice(10, HORIZON), slice(120, WIDTH))
    image = image_of([(*wall, (150.0, 140.0, 125.0), 2.0)])
    sky = sky_from_returns(image, returns_in((slice(45, HORIZON), wall[1])), camera)
    assert not sky[wall].any()
    assert float(sky[:70, :115].float().mean()) > 0.97


def test_a_view_onto_a_wall_has_no_sky(camera):
    wall = (slice(0, HORIZON), slice(0, WIDTH))
    image = image_of([(*wall, (200.0, 200.0, 200.0), 2.0)])
    assert not sky_from_returns(image, returns_in((slice(45, HORIZON), wall[1])), camera).any()


def test_wires_and_far_towers_without_returns_are_not_sky(camera):
    wire = (slice(30, 32), slice(0, WIDTH))
    tower = (slice(40, HORIZON), slice(60, 75))
    image = image_of([(*tower, (150.0, 150.0, 160.0), 14.0), (*wire, (60.0, 60.0, 60.0), 5.0)])
    sky = sky_from_returns(image, returns_in(), camera)
    assert not sky[wire].any()
    assert float(sky[tower].float().mean()) < 0.05
    assert float(sky[:28].float().mean()) > 0.97
    assert float(sky[35:75, 90:].float().mean()) > 0.97  # below the wire


@pytest.mark.parametrize("colour", [(120.0, 135.0, 120.0), (225.0, 205.0, 165.0)])
def test_a_smooth_tower_too_far_for_any_beam_is_not_sky(camera, colour):
    tower = (slice(20, HORIZON), slice(60, 90))
    image = image_of([(*tower, colour, 2.0)])
    sky = sky_from_returns(image, returns_in(), camera)
    assert not sky[tower].any()
    assert float(sky[:70, 100:].float().mean()) > 0.97


def test_sky_cut_in_two_by_a_building_is_sky_on_both_sides(camera):
    wall = (slice(0, HORIZON), slice(130, 150))
    image = image_of([(*wall, (150.0, 140.0, 125.0), 8.0)])
    sky = sky_from_returns(image, returns_in((slice(45, HORIZON), wall[1])), camera)
    assert float(sky[:70, :125].float().mean()) > 0.97
    assert float(sky[:70, 155:].float().mean()) > 0.97


def test_foliage_is_not_sky_and_gaps_in_it_may_be(camera):
    tree = (slice(20, HORIZON), slice(20, 80))
    image = image_of([(*tree, (60.0, 90.0, 40.0), 20.0)])
    sky = sky_from_returns(image, returns_in(tree), camera)
    assert not sky[tree].any()


def test_a_bright_cloud_in_the_sky_is_sky(camera):
    cloud = (slice(20, 40), slice(80, 120))
    image = image_of([(*cloud, (250.0, 248.0, 245.0), 2.0)])
    assert bool(sky_from_returns(image, returns_in(), camera)[cloud].all())


def test_a_recorded_view_is_masked_on_the_grid_asked_for():
    street = ToyStreet()
    view = street.views[0]
    camera = view.camera.resized(width_px=120, height_px=68)
    size = {"width_px": camera.width_px, "height_px": camera.height_px}
    image = shrink_image(street.read_image(view), **size)
    sky = sky_mask(image, street.read_points(view.frame_index).xyz_m, camera)
    assert sky.shape == (68, 120)
    truth = (street.read_image(view) == torch.tensor(SKY, dtype=torch.uint8)).all(-1)[::2, ::2]
    assert not (sky & ~truth).any()
    assert float((sky & truth).sum() / truth.sum()) > 0.8
