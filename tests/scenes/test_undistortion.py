"""Lenses become pinholes that show each direction once, without empty borders, within bounds."""

import cv2
import numpy as np
import pytest
import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.records import Distortion
from lidarpainter_models.scenes.undistortion import WIDEST_DEG, pinhole_of, undistort

WIDTH_PX, HEIGHT_PX = 160, 96


def lens(focal_px):
    return Camera(
        world_from_camera=torch.eye(4, dtype=torch.float64),
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=79.0,
        cy_px=49.0,
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
    )


LENSES = {
    "ordinary": (100.0, Distortion("brown", (-0.3, 0.1, 0.001, -0.002, 0.0))),
    "folds before its border": (100.0, Distortion("brown", (-0.8, 0.2, 0.0, 0.0))),
    "rational": (100.0, Distortion("brown", (-0.3, 0.1, 0, 0, 0.0, 0.1, 0.01, 0.001))),
    "fisheye": (90.0, Distortion("fisheye", (0.1, 0.0, 0.0, 0.0))),
    "fisheye of 180 degrees": (50.9, Distortion("fisheye", (0.0, 0.0, 0.0, 0.0))),
    "fisheye of 190 degrees": (48.2, Distortion("fisheye", (0.0, 0.0, 0.0, 0.0))),
    "fisheye that turns back": (106.0, Distortion("fisheye", (-0.235, 0.921, -2.505, 1.02))),
    "mei": (100.0, Distortion("mei", (1.2, -0.2, 0.05, 0.0, 0.001))),
    "wide mei": (60.0, Distortion("mei", (2.2, 0.01, 0.1, 0.001, 0.0))),
}


def landed(directions, camera, distortion):
    """Where OpenCV puts directions in the recorded image, the first pixel's centre at 0."""
    matrix = np.array(
        [[camera.fx_px, 0, camera.cx_px - 0.5], [0, camera.fy_px, camera.cy_px - 0.5], [0, 0, 1]]
    )
    points, none = directions.reshape(-1, 1, 3), np.zeros(3)
    terms = np.array(distortion.terms, dtype=np.float64)
    if distortion.model == "mei":
        found, _ = cv2.omnidir.projectPoints(points, none, none, matrix, terms[0], terms[1:])
    else:
        module = cv2.fisheye if distortion.model == "fisheye" else cv2
        found, _ = module.projectPoints(points, none, none, matrix, terms)
    return found.reshape(HEIGHT_PX, WIDTH_PX, 2)


@pytest.mark.parametrize("name", LENSES)
def test_every_pixel_shows_what_the_lens_saw_in_its_direction(name):
    focal_px, distortion = LENSES[name]
    camera = lens(focal_px)
    pinhole = pinhole_of(camera, distortion)
    across_deg = 2 * np.degrees(np.arctan(WIDTH_PX / 2 / pinhole.fx_px))
    assert 40 < across_deg <= WIDEST_DEG + 1e-6
    column, row = np.meshgrid(np.arange(WIDTH_PX), np.arange(HEIGHT_PX))
    recorded = np.stack([column, row, 0 * row], axis=-1).astype(np.uint8)
    shown = undistort(recorded, camera, distortion, pinhole)
    directions = pinhole.pixel_directions().numpy().astype(np.float64)
    expected = landed(directions, camera, distortion)
    # half a pixel of the border lies between the last centre and the image's edge
    inside = ((expected >= 0) & (expected <= [WIDTH_PX - 1, HEIGHT_PX - 1])).all(axis=-1)
    assert inside.mean() > 0.97
    assert np.abs(shown[..., :2].astype(float) - expected)[inside].max() < 1.0
    # no direction twice: farther out in the pinhole is farther out in the recorded image
    middle = expected[HEIGHT_PX // 2, WIDTH_PX // 2 :, 0]
    assert (np.diff(middle) > 0).all()


def test_a_lens_that_shows_next_to_nothing_once_is_refused():
    with pytest.raises(ConfigError, match="shows less than 25 degrees of its image once"):
        pinhole_of(lens(100.0), Distortion("brown", (-500.0, 0.0, 0.0, 0.0)))


def test_a_pinhole_stays_as_it_is():
    camera = lens(100.0)
    assert pinhole_of(camera, Distortion()) is camera
