"""A fit in plain torch on the CPU, which is what a GPU runs, is the fit of numba."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.gaussians.fitting.config import (
    DensificationConfig,
    FitConfig,
    RefinementConfig,
)
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.gaussians.initialisation.scene import initialise_scene
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.kernels.backends import kernels_chosen
from lidarpainter_models.observations.preparation import prepare_observations
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.splits import split_views
from lidarpainter_models.synthetic import SyntheticStreet, SyntheticStreetConfig, record_street
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS

STEPS = 100
CONFIG = FitConfig(
    steps=STEPS,
    initialisation=InitialisationConfig(num_gaussians=12_000),
    densification=DensificationConfig(start=1.0, stop=1.0),
    refinement=RefinementConfig(start_step=20),
)


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """The street of the demo, recorded small, and the scene that its fits start from."""
    folder = tmp_path_factory.mktemp("street")
    config = SyntheticStreetConfig(
        seed=1, num_frames=12, width_px=160, height_px=90, cameras=DEFAULT_CAMERAS[:1]
    )
    scene = DrivingScene.open(record_street(SyntheticStreet(config), folder))
    split = split_views(scene, "alternate", None)
    observations = prepare_observations(scene, split, ObservationConfig(width_px=160))
    return observations, initialise_scene(observations, CONFIG.initialisation)


def fitted(street, choice):
    observations, start = street
    with kernels_chosen(choice):
        return fit_gaussians(observations, CONFIG, start=start)


def apart(first, second):
    """Median and root mean square difference of each parameter, in standard deviations of it."""
    mine, theirs = (scene.gaussians.columns() for scene in (first, second))
    for name in first.gaussians.parameters():
        distance = (mine[name] - theirs[name]).abs() / mine[name].std()
        yield name, float(distance.median()), float(distance.square().mean().sqrt())


def nudged(scene):
    """The scene with every parameter one rounding away."""
    columns = {
        name: torch.nextafter(column, torch.full_like(column, torch.inf))
        for name, column in scene.gaussians.columns().items()
        if name in scene.gaussians.parameters()
    }
    return replace(scene, gaussians=replace(scene.gaussians, **columns))


@pytest.mark.slow
def test_plain_torch_follows_numba_for_a_hundred_steps(street):
    """Adam makes whole steps of gradients that are rounding alone, so a few faint Gaussians wander.

    So does numba's own fit from a start that is one rounding away: plain torch may be twice as far.
    """
    observations, start = street
    numba, twin = (fitted(street, choice) for choice in ("auto", "torch"))
    control = fitted((observations, nudged(start)), "auto")
    wandered = {name: found for name, *found in apart(numba.scene, control.scene)}
    for name, *found in apart(numba.scene, twin.scene):
        for figure, of_control, most in zip(found, wandered[name], (1e-3, 0.1), strict=True):
            assert figure < 2 * of_control, name
            assert of_control < most, name
    assert twin.history[-1]["psnr"] == pytest.approx(numba.history[-1]["psnr"], abs=0.05)
