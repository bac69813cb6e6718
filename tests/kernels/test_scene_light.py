"""Light of Gaussians: numba against plain torch, and plain torch against what is known."""

import math

import pytest
import torch
from gaussian_world import camera_at
from lit_surfaces import random_scene

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.scene_light import (
    Appearance,
    Lamps,
    Surfaces,
    Surroundings,
    irradiance,
    seen_harmonics,
)
from lidarpainter_models.weather.light import to_display

CURVE_ERROR = 1e-4 / 0.28
"""Of the compiled display curve, a table of 2048 steps, as a harmonic."""


def see(scene, camera, backend):
    surfaces, appearance, around, lamps, poses = scene
    eye = camera_at(-3.0)
    from_body = eye.camera_from_world @ poses
    return seen_harmonics(
        surfaces, appearance, around, lamps, camera, poses, from_body, backend=backend
    )


@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 500])
@pytest.mark.parametrize("camera", [camera_at(-3.0), None])
def test_both_backends_see_the_same(count, camera):
    scene = random_scene(count)
    plain, fast = (see(scene, camera, backend) for backend in ("reference", "cpu"))
    torch.testing.assert_close(fast, plain, rtol=1e-3, atol=CURVE_ERROR)
    if count > 100:
        in_view = (plain != 0).flatten(1).any(dim=1).float().mean()
        assert (in_view == 1) == (camera is None)
        assert in_view > 0.1


@pytest.mark.parametrize("count", [0, 1, 300])
def test_both_backends_throw_the_same_light(count):
    surfaces, _, _, lamps, poses = random_scene(count)
    plain, fast = (irradiance(surfaces, poses, lamps, backend=b) for b in ("reference", "cpu"))
    torch.testing.assert_close(fast, plain, rtol=1e-4, atol=1e-5)


def one_surface(distance_m=10.0):
    """A dark disc ahead that faces the eye."""
    surfaces = Surfaces(
        means=torch.tensor([[distance_m - 3.0, 0.0, 1.0]]),
        body_index=torch.zeros(1, dtype=torch.int32),
        reach_m=torch.full((1,), 0.1),
        normals=torch.tensor([[1.0, 0.0, 0.0]]),
        facing=torch.ones(1),
        least_facing=torch.zeros(1),
        body_radius_m=torch.tensor([distance_m]),
    )
    appearance = Appearance(
        light=torch.full((1, 3), 0.2),
        reflectance=torch.zeros(1, 3),
        harmonics=torch.zeros(1, 0, 3),
        per_base=torch.full((1, 3), 2.0),
        shine=torch.zeros(1),
        skyline=torch.full((1,), -1, dtype=torch.int32),
    )
    around = Surroundings(
        extinction_per_m=0.05,
        airlight=torch.tensor([0.6, 0.7, 0.8]),
        sky_light=torch.ones(3),
        skylines=torch.zeros(0, 8, 4),
    )
    none = torch.zeros(0, 3)
    lamps = Lamps(
        position_world=none,
        heading_world=none,
        power_rgb=none,
        reach_m=torch.zeros(0),
        is_fixed=torch.zeros(0, dtype=torch.bool),
    )
    return surfaces, appearance, around, lamps, torch.eye(4, dtype=torch.float64)[None]


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_air_takes_and_gives_by_koschmieders_law(backend):
    scene = one_surface(distance_m=10.0)
    through = math.exp(-0.5)
    light = 0.2 * through + torch.tensor([0.6, 0.7, 0.8]) * (1 - through)
    found = see(scene, camera_at(-3.0), backend)[0, 0] * 0.28209479177387814 + 0.5
    torch.testing.assert_close(found, to_display(light), atol=1e-4, rtol=0)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_light_of_a_lamp_falls_with_the_square_of_distance(backend):
    surfaces, _, _, lamps, poses = one_surface()
    found = []
    for away_m in (2.0, 4.0):
        lamp = Lamps(
            position_world=torch.tensor([[7.0 - away_m, 0.0, 1.0]]),
            heading_world=torch.zeros(1, 3),
            power_rgb=torch.ones(1, 3),
            reach_m=torch.full((1,), 1e4),
            is_fixed=torch.zeros(1, dtype=torch.bool),
        )
        found.append(float(irradiance(surfaces, poses, lamp, backend=backend)[0, 0]))
    assert found == pytest.approx([1 / (4 + 2), 1 / (16 + 2)], rel=1e-5)
    assert not irradiance(surfaces, poses, lamps, backend=backend).any()


def test_surfaces_and_light_of_different_number_are_refused():
    surfaces, appearance, around, lamps, poses = one_surface()
    two = appearance._replace(light=torch.zeros(2, 3))
    with pytest.raises(ShapeError, match="1 surfaces have the light of 2"):
        see((surfaces, two, around, lamps, poses), None, "reference")
    lost = surfaces._replace(body_index=torch.ones(1, dtype=torch.int32))
    with pytest.raises(ShapeError, match="body 1 of 1"):
        see((lost, appearance, around, lamps, poses), None, "reference")
