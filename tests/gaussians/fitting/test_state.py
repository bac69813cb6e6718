"""A long street, most of it out of view at every step."""

import copy

import pytest
import torch
from bench_iteration import Fit

from lidarpainter_models.gaussians.fitting.state import FitState
from lidarpainter_models.gaussians.model.drawing import camera_from_body

BLOCKS, PASSES = 4, 6
EPS = torch.finfo(torch.float32).eps


def steps_of(fit, count):
    for _ in range(count):
        fit.step()
    return fit


def street_fit(count=400, *, start_step=100):
    """`start_step` is that of the refinement of poses."""
    return Fit(count, 48, 32, blocks=BLOCKS, start_step=start_step)


def parameters_of(fit):
    return fit.state.caught_up().gaussians.columns()


def test_a_step_sees_its_own_part_of_the_street():
    fit = street_fit()
    scene, blocks = fit.state.scene, fit.state.blocks
    for row, image in enumerate(fit.images):
        pose = scene.cameras.world_from_camera(row).detach()
        bodies = camera_from_body(pose, *scene.actors.refined_poses_in_fit(0))
        rows = blocks.in_view([(image.camera.at(pose), bodies)]).nonzero()[:, 0]
        assert set((rows // 400).tolist()) == {row}


def test_what_is_out_of_view_changes_nothing_beyond_rounding(monkeypatch):
    """Against a fit whose every step looks at everything."""
    fit, everything = street_fit(start_step=0), street_fit(start_step=0)
    steps_of(fit, BLOCKS * PASSES)
    monkeypatch.setattr(
        type(everything.state.blocks),
        "in_view",
        lambda blocks, _views, **_slack: torch.ones_like(blocks.block_of_row, dtype=torch.bool),
    )
    steps_of(everything, BLOCKS * PASSES)
    truth, steps = parameters_of(everything), BLOCKS * PASSES
    longer = truth["log_scale"].sort(dim=1).values[:, 1:]
    size_m = longer.mean(dim=1, keepdim=True).exp()
    for name, value in parameters_of(fit).items():
        if name == "body_index":
            continue
        # Vector code rounds an exponential by its place in the array, and pose gradients are summed
        # in other groups. Adam makes steps of one length out of gradients of any: where one cancels
        # to a rounding of its terms, so does its step (by up to 0.03 of it for a handful, with
        # every scale and opacity moved by a rounding). A row left out would be a whole step off.
        step = fit.config.learning_rates.at(name, 0.0) * (size_m if name == "means" else 1.0)
        apart = ((value - truth[name]).abs() - EPS * steps * truth[name].abs()) / step
        assert float(apart.max()) <= 0.1, name
        assert float((apart > 1e-3).float().mean()) <= 0.01, name
    tangent, expected = (f.state.scene.cameras.view_tangent.detach() for f in (fit, everything))
    step = fit.config.learning_rates.at("camera_rotation_rad", 0.0)
    assert float(expected.abs().max()) > 10 * step
    assert float((tangent - expected).abs().max()) <= 0.01 * step
    assert torch.equal(fit.state.tally.visits, everything.state.tally.visits)


@pytest.mark.parametrize("kept_at", [1, 5, 11])
def test_kept_state_goes_on_bit_for_bit(kept_at):
    fit = steps_of(street_fit(), kept_at)
    tensors, numbers = copy.deepcopy(fit.state.keep())
    assert int(tensors["gaussian_adam/last"].min()) < kept_at  # some lag behind
    resumed = street_fit()
    resumed.state = FitState.resume(tensors, numbers, fit.config, fit.pixels)
    resumed.view = fit.view
    steps_of(fit, 9), steps_of(resumed, 9)
    expected = parameters_of(fit)
    for name, value in parameters_of(resumed).items():
        assert torch.equal(value, expected[name]), name
    assert torch.equal(
        fit.state.scene.cameras.view_tangent, resumed.state.scene.cameras.view_tangent
    )
