"""A camera that is a third brighter than its neighbour, and grows brighter still during the log."""

from dataclasses import replace
from statistics import fmean

import pytest
import torch
from fitted_street import FittedStreet

from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.fitting.refinement import Refinement
from lidarpainter_models.gaussians.model.corrections import ExposureCorrections
from lidarpainter_models.synthetic import SyntheticStreetConfig
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS

FRONT, _, SIDE = DEFAULT_CAMERAS
STREET = SyntheticStreetConfig(
    seed=7, num_frames=24, width_px=240, height_px=136, cameras=(FRONT, replace(SIDE, gain=1.0))
)
GAIN, DRIFT_PER_S = 1.3, 0.1
BRIGHTER = replace(STREET, cameras=(FRONT, replace(SIDE, gain=GAIN, gain_drift=DRIFT_PER_S)))

SEEDS = (0, 1, 2, 3)
"""Fits of one street part by 0.1 to 0.2 dB, as much as is judged: their means count."""


class Exposed(FittedStreet):
    """A fit of a street whose cameras are exposed differently."""

    def __init__(self, street, folder, seed):
        super().__init__(street, folder, FitConfig(seed=seed))
        self.cameras = {camera.name: camera for camera in street.cameras}

    def gain(self, camera_name, timestamp_ns):
        """How much brighter a camera was at a time."""
        camera, log = self.cameras[camera_name], self.held_out.scene
        since_s = (timestamp_ns - int(log.frame_timestamps_ns[0])) * 1e-9
        return camera.gain * (1 + camera.gain_drift * since_s)

    def psnr(self, camera_name):
        """Mean over a camera's views, errors in the light of a camera of gain 1.

        Pixels that are white in the brighter camera are left out.
        """
        found = []
        for name, view, image in self.shown():
            if name == camera_name:
                gain = self.gain(name, view.timestamp_ns)
                is_told = (view.truth_rgb < 0.98 * gain / GAIN / (1 + 3 * DRIFT_PER_S)).all(dim=-1)
                error = ((image - view.truth_rgb) / gain)[is_told].square().mean()
                found.append(-10 * error.log10())
        return float(torch.stack(found).mean())

    def colour_difference(self):
        """Of the side camera's images, brought to the scene's colours, from what both show."""
        front = {v.timestamp_ns: v.camera for n, v, _ in self.shown() if n == FRONT.name}
        differences = []
        for name, view, _ in self.shown():
            if name == FRONT.name:
                continue
            plain = self.scene.render(view.camera, view.timestamp_ns)
            points = view.camera.unproject(plain.depth_m)
            there = front[view.timestamp_ns]
            both = there.contains(*there.project(points.flatten(0, 1))).view(points.shape[:2])
            both &= (plain.depth_m > 0) & (view.truth_rgb < 0.98).all(dim=-1)
            undone = self.scene.exposure.undone(view.truth_rgb, name, view.timestamp_ns)
            differences.append((undone - plain.rgb)[both])
        return 255 * torch.cat(differences).mean(dim=0)


def fits_of(street, folder):
    """A fit for every seed."""
    return [Exposed(street, folder, seed) for seed in SEEDS]


def as_if_alike(camera_names, _names, timestamps_ns, _shown):
    return ExposureCorrections.none(camera_names, timestamps_ns)


@pytest.mark.slow
def test_a_brighter_camera_that_drifts_is_brought_back(tmp_path, monkeypatch, capsys):
    fits = {
        "alike": fits_of(STREET, tmp_path / "alike"),
        "corrected": fits_of(BRIGHTER, tmp_path / "brighter"),
    }
    monkeypatch.setattr(Refinement, "refines_exposure", False)
    monkeypatch.setattr(ExposureCorrections, "measured", as_if_alike)
    fits["left"] = fits_of(BRIGHTER, tmp_path / "left")
    psnr = {
        name: {camera.name: [one.psnr(camera.name) for one in those] for camera in STREET.cameras}
        for name, those in fits.items()
    }
    difference = torch.stack([one.colour_difference() for one in fits["corrected"]])
    with capsys.disabled():
        for name, by_camera in psnr.items():
            print(f"\n{name}: {by_camera}")  # noqa: T201
        print(f"colours in the overlap, of 255: {difference.tolist()}")  # noqa: T201
    for camera in STREET.cameras:
        alike, corrected, left = (
            fmean(psnr[name][camera.name]) for name in ("alike", "corrected", "left")
        )
        assert corrected - left > 0.8 * (alike - left), camera.name
    assert float(difference.abs().max()) < 2
