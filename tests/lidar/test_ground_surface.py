"""The ground as a height field: as high as it is, without what stands on it, without holes."""

import numpy as np
import pytest
from made_road import LENGTH_M, bent, height_m, map_points, road_path, road_points

from lidarpainter_models.errors import SceneError
from lidarpainter_models.lidar.ground_surface import ground_surface


@pytest.fixture(scope="module")
def road():
    """A curved road, its surface, and points that it was not made of."""
    curvature = 1 / 120
    surface = ground_surface(
        map_points(road_points(250_000, curvature_per_m=curvature)[0]), road_path(curvature)
    )
    return surface, road_points(20_000, curvature_per_m=curvature, seed=9, noise_m=0.0)


def test_ground_is_as_high_as_it_is_beside_a_kerb_too(road):
    surface, (xyz_m, sd, stands) = road
    near = ~stands & (np.abs(sd[:, 1]) < 10) & (sd[:, 0] > -40) & (sd[:, 0] < LENGTH_M + 40)
    error_m = np.abs(surface.at(xyz_m[near, :2]) - xyz_m[near, 2])
    assert np.isfinite(error_m).all()
    assert np.median(error_m) < 0.01
    assert np.quantile(error_m, 0.95) < 0.04


def test_what_stands_on_the_ground_is_no_ground(road):
    surface, (xyz_m, sd, stands) = road
    on_car = stands & (sd[:, 1] < 0)
    assert on_car.sum() > 20
    below = surface.at(xyz_m[on_car, :2])
    true_m = height_m(*sd[on_car].T)
    assert np.nanmax(np.abs(below - true_m)) < 0.2  # closed under the car, or left open


def test_mesh_and_lookup_are_one_surface_whose_faces_look_up(road):
    surface, _ = road
    vertices, faces = surface.mesh()
    corners = vertices[faces].astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).all()
    middles = corners.mean(axis=1)[::97]
    np.testing.assert_allclose(surface.at(middles[:, :2]), middles[:, 2], atol=1e-4)
    assert np.isnan(surface.at(np.array([[1e4, 0.0], [np.nan, 0.0]]))).all()


def test_the_road_under_the_recording_car_is_closed():
    surface = ground_surface(map_points(road_points(250_000, below_car=False)[0]), road_path())
    s = np.linspace(1, LENGTH_M - 1, 200)
    found = surface.at(bent(s, 0.0))
    np.testing.assert_allclose(found, height_m(s, 0.0), atol=0.03)


def test_wide_holes_stay_open():
    xyz_m, sd, _ = road_points(250_000)
    kept = (np.abs(sd[:, 0] - 20) > 4) | (np.abs(sd[:, 1] - 7) > 4)
    surface = ground_surface(map_points(xyz_m[kept]), road_path())
    assert np.isnan(surface.at(bent([20.0], [7.0]))).all()


def test_too_few_points_are_told_in_one_line():
    with pytest.raises(SceneError, match="3 LiDAR points within 50 m of the path"):
        ground_surface(map_points(np.zeros((3, 3))), road_path())
