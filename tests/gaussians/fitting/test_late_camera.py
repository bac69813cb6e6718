"""What it costs that a camera is late and turned, and how much of it is back once that is found."""

import math
from dataclasses import replace
from statistics import fmean

import pytest
from fitted_street import FittedStreet

from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.synthetic import SyntheticStreetConfig
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS, RigLidar

FRONT, _, SIDE = DEFAULT_CAMERAS
LATE_S, YAW_RAD = 0.05, math.radians(0.5)
SOUND = SyntheticStreetConfig(
    seed=7,
    num_frames=20,
    width_px=320,
    height_px=180,
    speed_mps=(15.0, 15.0),
    cameras=(FRONT, SIDE),
    lidar=RigLidar(columns=1200),
)
WRONG = replace(SOUND, cameras=(FRONT, replace(SIDE, delay_s=LATE_S, yaw_error_rad=YAW_RAD)))
FITS = {
    "sound": (SOUND, {}),
    "left as it is": (WRONG, {}),
    "corrected": (WRONG, {"corrects_cameras": True}),
}


def psnr(fit, camera_name):
    """Mean over a camera's held-out views, in dB."""
    errors = [
        (image - view.truth_rgb).square().mean()
        for name, view, image in fit.shown()
        if name == camera_name
    ]
    return fmean(-10 * float(error.log10()) for error in errors)


@pytest.mark.slow
def test_what_a_late_and_turned_camera_costs_is_back_once_it_is_found(tmp_path, capsys):
    found = {}
    for number, (kind, (street, observed)) in enumerate(FITS.items()):
        fit = FittedStreet(street, tmp_path / str(number), FitConfig(), **observed)
        found[kind] = {camera.name: psnr(fit, camera.name) for camera in street.cameras}
    with capsys.disabled():
        print(f"\n{found}")  # noqa: T201
    loss, back = (
        found[better][SIDE.name] - found["left as it is"][SIDE.name]
        for better in ("sound", "corrected")
    )
    assert loss > 1
    assert back > 0.7 * loss
