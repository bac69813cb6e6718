"""People who walk: their steps are found in the images, and only theirs."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import FRAME_NS

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.gaussians.fitting.config import (
    DensificationConfig,
    FitConfig,
    RefinementConfig,
)
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.gaussians.fitting.state import FitState
from lidarpainter_models.gaussians.fitting.step import add_guidance_gradients
from lidarpainter_models.gaussians.initialisation import scene as first_scene
from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.stored_scene import copy_scene
from lidarpainter_models.observations.preparation import prepare_observations
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.observations.views import GuidanceView
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.splits import split_views
from lidarpainter_models.synthetic import RigCamera, SyntheticStreetConfig, write_street

STREET = SyntheticStreetConfig(
    seed=12,
    num_frames=20,
    width_px=288,
    height_px=180,
    cameras=(RigCamera(name="front_camera", focal_per_width=1.8, yaw_rad=-0.35),),
    speed_mps=(2.0, 2.0),
    are_people_walking=True,
)
WALKER = "person-006"
"""47 to 64 pixels tall, with the longest steps of three."""


def with_lattice(scene):
    """A copy whose car may bend."""
    scene = copy_scene(scene)
    actors = Actors.uncorrected(scene.actors.recorded_tracks, scene.actors.knots_ns, bent=[0])
    return replace(scene, actors=actors)


def test_painted_views_leave_no_gradient_to_how_somebody_moves(world):
    view = world.observations.views[1]
    painted = GuidanceView.of(
        view.camera,
        FRAME_NS,
        rgb=torch.full_like(view.rgb, 0.2),
        weight=torch.ones(view.sky_mask.shape),
        lidar_depth_m=view.lidar_depth_m,
    )
    config = FitConfig(steps=4)
    state = FitState.begin(with_lattice(world.scene), config, painted.weight_u8.numel())
    posed = state.scene.posed_in_fit(view.camera, FRAME_NS)
    seen = state.seen({~0: posed.looks()})
    add_guidance_gradients(state, seen, painted, posed)
    assert state.scene.actors.bending.offset_m.grad is None


def seen_of(world, scene):
    """What the cameras of the world see of another scene."""
    views = [
        replace(view, rgb_u8=(scene.render(view.camera, time_ns).rgb.clamp(0, 1) * 255).byte())
        for view in world.observations.views
        for time_ns in [view.timestamp_ns]
    ]
    return replace(world.observations, views=tuple(views))


def actor_error(scene, view):
    shown = scene.render(view.camera, view.timestamp_ns, view_key=view.key)
    return float((shown.rgb - view.rgb).square()[shown.actor_alpha > 0.5].mean())


def test_a_fit_finds_how_somebody_moves(world):
    truth = with_lattice(world.scene)
    # whoever is in the box lifts one side and lowers the other, and the other way round
    swing_m = 0.15 * torch.tensor([1.0, -1.0, 1.0, -1.0])[:, None]
    nodes = truth.actors.bending.offset_m[:, 0].unflatten(1, (3, 3, 5))
    nodes[:, 0, ..., 2] += swing_m[..., None]
    nodes[:, 2, ..., 2] -= swing_m[..., None]
    seen = seen_of(world, truth)
    config = FitConfig(
        steps=80,
        half_resolution=0.0,
        densification=DensificationConfig(budget=len(truth.gaussians), start=0.9, stop=0.9),
        refinement=RefinementConfig(cameras=False, start_step=0),
    )
    bent, rigid = (
        fit_gaussians(seen, config, start=start).scene
        for start in (with_lattice(world.scene), world.scene)
    )
    errors = [sum(actor_error(one, view) for view in seen.views) for one in (bent, rigid)]
    assert errors[0] < 0.6 * errors[1]
    assert float(bent.actors.bending.offset_at(2 * FRAME_NS).abs().max()) > 0.05
    assert not len(rigid.actors.bending.bodies)


def psnr_by_walker(held_out, scene):
    """Over the pixels of each person's box in all held-out views."""
    errors = {}
    for view in held_out.recorded_views(scene, "interpolated"):
        shown = scene.render(view.camera, view.timestamp_ns, camera_name="front_camera").rgb
        error = (shown.clamp(0, 1) - view.truth_rgb).square().mean(-1)
        for row, name in enumerate(view.actor_ids):
            inside = error[view.actor_index == row]
            if name.startswith("person") and len(inside):
                errors.setdefault(name, []).append(inside)
    return {name: -10 * float(torch.cat(found).mean().log10()) for name, found in errors.items()}


@pytest.mark.slow
def test_a_walker_gains_on_rigid_ones(tmp_path, monkeypatch, capsys):
    scene = DrivingScene.open(write_street(STREET, tmp_path))
    split = split_views(scene, "alternate", ("front_camera",))
    size = ObservationConfig(width_px=STREET.width_px)
    seen = prepare_observations(scene, split, size)
    held_out = HeldOut(scene=scene, test_views=split.test, observation=size)
    bent = psnr_by_walker(held_out, fit_gaussians(seen, FitConfig()).scene)
    monkeypatch.setattr(first_scene, "BENDING", set())
    rigid = psnr_by_walker(held_out, fit_gaussians(seen, FitConfig()).scene)
    with capsys.disabled():
        for name, psnr in bent.items():
            print(f"\n{name}: rigid {rigid[name]:.2f} dB, bent {psnr:.2f} dB")  # noqa: T201
    assert bent[WALKER] > rigid[WALKER] + 1.5
    assert all(psnr > rigid[name] for name, psnr in bent.items())
