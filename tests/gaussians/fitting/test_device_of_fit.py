"""A fit on another device than the CPU: everything lies there, and the host hardly waits for it."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import FRAME_NS, HEIGHT_PX, WIDTH_PX
from strict_device import NAME, StrictTensor, most_held, strict_runs, waits

from lidarpainter_models.errors import DeviceMemoryError
from lidarpainter_models.gaussians.fitting import fit as fit_module
from lidarpainter_models.gaussians.fitting.checkpoint import CheckpointFolder
from lidarpainter_models.gaussians.fitting.config import (
    DensificationConfig,
    FitConfig,
    GuidanceConfig,
    RefinementConfig,
)
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.gaussians.fitting.images import full_image
from lidarpainter_models.gaussians.fitting.memory import planned_memory
from lidarpainter_models.gaussians.fitting.state import FitState
from lidarpainter_models.gaussians.fitting.step import WAITS, fit_step
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.observations.views import GuidanceView

CONFIG = FitConfig(
    steps=12,
    log_every=6,
    initialisation=InitialisationConfig(num_gaussians=700, street_voxel_m=0.2),
    densification=DensificationConfig(budget=900, start=0.2, stop=0.8, every=4),
    refinement=RefinementConfig(start_step=2, exposure=True),
    guidance=GuidanceConfig(probability=0.5),
)


@pytest.fixture
def device(monkeypatch):
    with strict_runs(monkeypatch) as found:
        yield found


def painted_view(world):
    view = world.observations.views[1]
    return GuidanceView.of(
        view.camera,
        FRAME_NS,
        rgb=torch.full_like(view.rgb, 0.2),
        weight=torch.full(view.sky_mask.shape, 0.7),
        lidar_depth_m=view.lidar_depth_m,
    )


def test_a_fit_runs_on_its_device_and_is_that_of_the_cpu(world, device):
    guidance = (painted_view(world),)
    on_cpu = fit_gaussians(world.observations, CONFIG, guidance=guidance)
    there = fit_gaussians(world.observations, CONFIG, guidance=guidance, device=device)
    assert there.scene.device.type == NAME
    assert all(isinstance(v, StrictTensor) for v in there.scene.gaussians.columns().values())
    assert there.history[-1]["num_gaussians"] == on_cpu.history[-1]["num_gaussians"]
    # 12 steps of other roundings, some of which split other Gaussians
    assert there.history[-1]["psnr"] == pytest.approx(on_cpu.history[-1]["psnr"], abs=0.1)


def test_a_fit_is_taken_up_on_another_device_than_it_was_left_on(world, device, tmp_path):
    folder = CheckpointFolder(path=tmp_path, every_seconds=0.0)

    def stop(now):
        if now.step == 6:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        fit_gaussians(world.observations, CONFIG, checkpoints=folder, progress=stop)
    found = fit_gaussians(world.observations, CONFIG, checkpoints=folder, device=device)
    assert found.history[-1]["step"] == CONFIG.steps
    assert found.scene.device.type == NAME


@pytest.mark.parametrize("bent", [(), (0,)])
def test_a_step_makes_the_host_wait_no_oftener_than_it_says(world, device, bent):
    actors = world.scene.actors
    actors = Actors.uncorrected(actors.recorded_tracks, actors.knots_ns, bent)
    state = FitState.begin(
        replace(world.scene, actors=actors).to(device), CONFIG, WIDTH_PX * HEIGHT_PX
    )
    image = full_image(world.observations.views[0]).to(device)
    painted = painted_view(world).to(device)
    state.step = 3  # corrections are refined by now, and actors are not looked at
    for guidance in (None, (0, painted), (0, painted)):
        views = 1 if guidance is None else 2
        at_everything = sum(state.hidden.is_due(view) for view in (0, ~0)[:views])
        waits.clear()
        fit_step(state, image, 0, guidance)
        state.step += 1
        # of plain torch: no other kernel runs on this device
        assert waits.total() <= WAITS + views * len(bent) + at_everything, waits


def out_of_memory(times):
    """A step that finds no memory a number of times, then goes on."""
    left = [times]

    def step(*args):
        if left[0]:
            left[0] -= 1
            raise torch.OutOfMemoryError("out of memory\nwith a stack of lines")
        return fit_step(*args)

    return step


@pytest.mark.slow
def test_a_fit_without_room_leaves_its_images_on_the_cpu(world, device, monkeypatch):
    plans = []

    def told(now):
        plans.extend([now.plan.planned_bytes] if now.step == 0 and now.placed is None else [])

    expected = fit_gaussians(world.observations, CONFIG, device=device)
    monkeypatch.setattr(fit_module, "fit_step", out_of_memory(1))
    found = fit_gaussians(world.observations, CONFIG, device=device, progress=told)
    assert found.history[-1]["psnr"] == expected.history[-1]["psnr"]
    assert plans[1] < plans[0]


def test_a_fit_that_fits_nowhere_says_so_in_one_line_and_is_refused(world, device, monkeypatch):
    monkeypatch.setattr(fit_module, "fit_step", out_of_memory(2))
    with pytest.raises(DeviceMemoryError, match="strict:0 has too little memory for the fit") as no:
        fit_gaussians(world.observations, CONFIG, device=device)
    assert "\n" not in str(no.value)


def test_a_fit_takes_about_the_memory_that_was_planned(world, device):
    plan = planned_memory(
        world.observations, CONFIG, world.scene.sky.layout, guidance=(painted_view(world),)
    )
    with most_held() as peak:
        fit_gaussians(world.observations, CONFIG, device=device, guidance=(painted_view(world),))
    expected = plan.total - plan.rasteriser  # numba's takes its memory elsewhere
    assert 0.5 * expected < peak.bytes < 1.2 * expected, (plan, peak.bytes)
