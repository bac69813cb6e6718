"""A camera that reads its rows one after another, at 15 m/s among traffic: what a fit loses by it.

The same street is recorded at once (`global`), in 30 ms that are told, and in 30 ms that nobody
tells and that are fitted as if at once (`left`). All are judged on the same images, those read in
30 ms: images that are read at once show other parts of the street, which can be 0.1 dB easier.
"""

from dataclasses import replace
from statistics import fmean

import pytest
import torch
from fitted_street import FittedStreet

from lidarpainter_models.gaussians.fitting.config import EffortConfig, FitConfig
from lidarpainter_models.lidar.spatiotemporal_calibration import find_faults
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.splits import split_views
from lidarpainter_models.synthetic import SyntheticStreetConfig, write_street
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS

READOUT_S = 0.03
LENSES = {"front": 1.026, "wide": 0.6}
"""Focal lengths in image widths; through a wide lens what is near moves much."""
EFFORT = EffortConfig(looks=300)
SEEDS = (0, 1, 2)
"""Fits of one street part by about 0.1 dB, nearly as much as is judged: their means count."""


def psnr(fitted, held_out):
    """Mean over these images."""
    shown = fitted.shown(held_out)
    errors = [(image - view.truth_rgb).square().mean() for _, view, image in shown]
    return float((-10 * torch.stack(errors).log10()).mean())


def street(lens, **shutter):
    """The street through a lens, read at once if nothing else is said."""
    camera = replace(DEFAULT_CAMERAS[0], focal_per_width=LENSES[lens], **shutter)
    return SyntheticStreetConfig(
        seed=7,
        num_frames=16,
        width_px=240,
        height_px=136,
        speed_mps=(15.0, 15.0),
        cameras=(camera,),
    )


@pytest.mark.slow
@pytest.mark.parametrize("lens", LENSES)
def test_what_a_rolling_shutter_costs_is_recovered_where_it_is_told(lens, tmp_path, capsys):
    told = street(lens, readout_s=READOUT_S)
    ways = {"global": street(lens), "told": told, "left": replace(told, is_readout_told=False)}
    configs = [FitConfig(effort=EFFORT, seed=seed) for seed in SEEDS]
    fits = {
        name: [FittedStreet(recorded, tmp_path / name, config) for config in configs]
        for name, recorded in ways.items()
    }
    judged = {"global": fits["told"][0].held_out}
    found = {
        name: fmean(psnr(fit, judged.get(name, fit.held_out)) for fit in fitted)
        for name, fitted in fits.items()
    }
    lost = found["global"] - found["left"]
    recovered = (found["told"] - found["left"]) / lost
    own = fmean(psnr(fit, fit.held_out) for fit in fits["global"])
    of_own = (found["told"] - found["left"]) / (own - found["left"])
    with capsys.disabled():
        print(  # noqa: T201
            f"\n{lens}: {found}, recovered {recovered:.2f} of {lost:.3f} dB; read at once and "
            f"judged on images read at once {own:.3f}, of that {of_own:.2f}"
        )
    assert lost > 0
    assert recovered > 0.8


@pytest.mark.slow
@pytest.mark.parametrize("lens", LENSES)
def test_a_camera_that_reads_at_once_is_left_as_it_is(lens, tmp_path, capsys):
    untold = replace(street(lens, readout_s=READOUT_S), is_readout_told=False)
    found = {}
    for name, recorded in {"global": street(lens), "untold": untold}.items():
        scene = DrivingScene.open(write_street(recorded, tmp_path / name))
        faults = find_faults(scene, split_views(scene, "alternate").train)
        found[name] = [f"{camera} {fault}" for camera, fault in faults.items()]
    with capsys.disabled():
        print(f"\n{lens}: {found}")  # noqa: T201
    assert not found["global"]
