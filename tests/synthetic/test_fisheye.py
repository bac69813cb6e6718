"""A street's fisheye images are what their stored lens says."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from fisheye_street import FisheyeStreet

from lidarpainter_models.metrics.images import psnr_from_error
from lidarpainter_models.scenes.undistortion import pinhole_of, undistort
from lidarpainter_models.synthetic import SyntheticStreetConfig
from lidarpainter_models.synthetic.config import RigCamera

CAMERAS = (
    RigCamera(name="left_fisheye", focal_per_width=0.714, yaw_rad=1.57, left_m=0.9),
    RigCamera(name="front_camera", focal_per_width=0.714),
)


@pytest.fixture(scope="module")
def street():
    config = SyntheticStreetConfig(
        seed=5, num_frames=1, width_px=160, height_px=90, cameras=CAMERAS
    )
    return FisheyeStreet(config)


def test_an_undistorted_fisheye_shows_what_a_pinhole_would(street):
    (time_ns,) = street.timestamps_ns
    lens, distortion = street.camera("left_fisheye", time_ns), street.distortion("left_fisheye")
    recorded = street.render_recorded("left_fisheye", time_ns).rgb
    pinhole = pinhole_of(lens, distortion)
    assert 2 * np.rad2deg(np.arctan(pinhole.width_px / 2 / pinhole.fx_px)) > 100
    image = np.round(255 * recorded.numpy()).astype(np.uint8)
    shown = torch.from_numpy(undistort(image, lens, distortion, pinhole)) / 255

    def psnr_if(u_px: float, v_px: float) -> float:
        middle = {"cx_px": pinhole.cx_px + u_px, "cy_px": pinhole.cy_px + v_px}
        exact = street.render(replace(pinhole, **middle), time_ns).rgb
        return psnr_from_error(float((shown - exact).square().mean()))

    # resampling costs detail, as much to each side; a lens that is a pixel off would cost more
    beside = [psnr_if(*offset) for offset in ((-1, 0), (1, 0), (0, -1), (0, 1))]
    assert psnr_if(0, 0) > max(beside) + 2


def test_a_camera_of_another_name_stays_a_pinhole(street):
    (time_ns,) = street.timestamps_ns
    assert street.distortion("front_camera").model == "none"
    camera = street.camera("front_camera", time_ns)
    assert camera.fx_px == pytest.approx(0.714 * 160)
    recorded = street.render_recorded("front_camera", time_ns).rgb
    torch.testing.assert_close(recorded, street.render(camera, time_ns).rgb)
