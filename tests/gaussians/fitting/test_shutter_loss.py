"""A camera that reads its rows one after another, at 15 m/s among traffic: what a fit loses by it.

The same street is recorded at once (`global`), in 30 ms that are told, and in 30 ms that nobody
tells: fitted as if at once (`left`), and with the readout looked for (`looked for`).
"""

from dataclasses import replace

import pytest
import torch
from fitted_street import FittedStreet

from lidarpainter_models.gaussians.fitting.config import EffortConfig, FitConfig
from lidarpainter_models.synthetic import SyntheticStreetConfig
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS

READOUT_S = 0.03
LENSES = {"front": 1.026, "wide": 0.6}
"""Focal lengths in image widths; through a wide lens what is near moves much."""
CONFIG = FitConfig(effort=EffortConfig(looks=300))


def psnr(fitted):
    """Mean over held-out views of the images as they were recorded."""
    errors = [(image - view.truth_rgb).square().mean() for _, view, image in fitted.shown()]
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
@pytest.mark.parametrize(("lens", "least_recovered"), [("front", 0.5), ("wide", 0.0)])
def test_what_a_rolling_shutter_costs_is_recovered(lens, least_recovered, tmp_path, capsys):
    at_once, told = street(lens), street(lens, readout_s=READOUT_S)
    untold, looked_for = replace(told, is_readout_told=False), {"corrects_cameras": True}
    ways = {
        "global": (at_once, {}),
        "global, looked for": (at_once, looked_for),
        "told": (told, {}),
        "looked for": (untold, looked_for),
        "left": (untold, {}),
    }
    found = {}
    for name, (recorded, observation) in ways.items():
        fitted = FittedStreet(recorded, tmp_path / name, CONFIG, **observation)
        found[name] = psnr(fitted)
        faults = [f"{camera} {fault}" for camera, fault in fitted.seen.faults.items()]
        with capsys.disabled():
            print(f"\n{lens}, {name}: {found[name]:.3f} dB, {faults or 'no fault'}")  # noqa: T201
    lost = found["global"] - found["left"]
    assert found["told"] - found["left"] > least_recovered * lost
    assert found["global"] - found["global, looked for"] < 0.02
    assert found["looked for"] > found["left"] - 0.02
