from dataclasses import replace

import numba
import pytest
import torch
from gaussian_world import FRAME_NS, HEIGHT_PX, WIDTH_PX, scene_of

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.gaussians.fitting import fit as fit_module
from lidarpainter_models.gaussians.fitting import step
from lidarpainter_models.gaussians.fitting.checkpoint import CheckpointFolder
from lidarpainter_models.gaussians.fitting.config import (
    DensificationConfig,
    FitConfig,
    GuidanceConfig,
    RefinementConfig,
    continuation,
)
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.gaussians.fitting.images import full_image
from lidarpainter_models.gaussians.fitting.learning_rates import LearningRates
from lidarpainter_models.gaussians.fitting.state import FitState
from lidarpainter_models.gaussians.fitting.step import add_guidance_gradients, fit_step
from lidarpainter_models.gaussians.initialisation.scene import initialise_scene
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.gaussians.model.drawing import camera_from_body, draw_gaussians
from lidarpainter_models.gaussians.model.rolling_shutter import as_read
from lidarpainter_models.gaussians.model.stored_scene import scene_to_arrays
from lidarpainter_models.geometry.cameras import Shutter
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.observations.views import GuidanceView

STEPS = 40


def short_fit(**changes):
    config = FitConfig(
        steps=STEPS,
        half_resolution=0.25,
        initialisation=InitialisationConfig(num_gaussians=700, street_voxel_m=0.2),
        densification=DensificationConfig(budget=900, start=0.2, stop=0.8, every=8),
        refinement=RefinementConfig(start_step=5),
        log_every=1,
    )
    return replace(config, **changes)


def painted_view(world, *, weight=1.0, lidar_m=0.0):
    camera = world.observations.views[1].camera
    return GuidanceView.of(
        camera,
        FRAME_NS,
        rgb=torch.full((HEIGHT_PX, WIDTH_PX, 3), 0.2),
        weight=torch.full((HEIGHT_PX, WIDTH_PX), weight),
        lidar_depth_m=torch.full((HEIGHT_PX, WIDTH_PX), lidar_m),
    )


def assert_same_scene(first, second):
    first_arrays, first_numbers = scene_to_arrays(first)
    second_arrays, second_numbers = scene_to_arrays(second)
    assert first_numbers == second_numbers
    assert first_arrays.keys() == second_arrays.keys()
    for name, value in first_arrays.items():
        assert torch.equal(value, second_arrays[name]), name


class KilledError(Exception):
    pass


def kill_at(step):
    def progress(now):
        if now.step == step:
            raise KilledError

    return progress


@pytest.fixture(scope="module")
def undisturbed(world):
    return fit_gaussians(world.observations, short_fit())


def image_error(world, scene):
    errors = [
        (scene.render(view.camera, view.timestamp_ns, view_key=view.key).rgb - view.rgb).abs()
        for view in world.observations.views
    ]
    return float(torch.stack(errors).mean())


def test_a_step_sees_what_only_the_first_row_shows(world):
    actors, view = world.scene.actors, world.observations.views[0]
    aside = torch.tensor([0.0, 0.0, 0.0, 100.0, 0.0, 0.0]).double()
    camera = replace(
        view.camera,
        fx_px=4 * view.camera.fx_px,
        fy_px=4 * view.camera.fy_px,
        shutter=Shutter(across_s=(0.0, 0.06), twist_per_s=aside),
    )
    view = replace(view, camera=camera)
    bodies = camera_from_body(
        view.camera.world_from_camera, *actors.refined_poses_in_fit(view.timestamp_ns)
    )
    read = as_read(world.scene.gaussians, bodies, view.camera, actors, view.timestamp_ns)
    shown = draw_gaussians(read, bodies, view.camera).visible
    state = FitState.begin(world.scene, short_fit(), WIDTH_PX * HEIGHT_PX)
    fit_step(state, full_image(view), 0)
    assert torch.equal(state.tally.visits > 0, shown)


def test_fit_gets_closer_to_the_images(world, undisturbed):
    start = initialise_scene(world.observations, short_fit().initialisation)
    assert image_error(world, undisturbed.scene) < 0.95 * image_error(world, start)
    assert undisturbed.history[-1]["step"] == STEPS


def test_a_car_that_drives_into_the_shade_is_found_to_grow_dark(world):
    views = list(world.observations.views)
    for row in (2, 3):
        shown = world.scene.render(views[row].camera, views[row].timestamp_ns)
        share = torch.where(shown.actor_alpha > 0.5, 0.5, 1.0)[..., None]
        dark = (views[row].rgb * share * 255).round().to(torch.uint8)
        views[row] = replace(views[row], rgb_u8=dark)
    seen = replace(world.observations, views=tuple(views))
    gain = fit_gaussians(seen, short_fit(steps=120)).scene.actors.light.log_gain.detach().exp()
    assert bool((gain[2:, 0] < 0.85 * gain[:2, 0]).all()), gain
    steady = fit_gaussians(world.observations, short_fit(steps=120)).scene.actors.light.log_gain
    assert float(steady.detach().abs().max()) < 0.15


def test_budget_is_never_exceeded(undisturbed):
    numbers = [entry["num_gaussians"] for entry in undisturbed.history]
    assert max(numbers) <= 900
    assert max(numbers) > numbers[0]


@pytest.mark.parametrize("killed_at", [6, 15, 30])
def test_resumed_fit_is_the_undisturbed_one_bit_for_bit(world, undisturbed, tmp_path, killed_at):
    folder = CheckpointFolder(path=tmp_path, every_seconds=0.0)
    with pytest.raises(KilledError):
        fit_gaussians(
            world.observations, short_fit(), checkpoints=folder, progress=kill_at(killed_at)
        )
    resumed = fit_gaussians(world.observations, short_fit(), checkpoints=folder)
    assert_same_scene(resumed.scene, undisturbed.scene)
    assert [e["step"] for e in resumed.history] == [e["step"] for e in undisturbed.history]


def test_checkpoint_of_another_fit_is_refused(world, tmp_path):
    mine = CheckpointFolder(path=tmp_path, identity="mine", every_seconds=0.0)
    with pytest.raises(KilledError):
        fit_gaussians(world.observations, short_fit(), checkpoints=mine, progress=kill_at(4))
    other = replace(mine, identity="other")
    with pytest.raises(SceneError, match="another fit"):
        fit_gaussians(world.observations, short_fit(), checkpoints=other)


def test_pose_refinement_recovers_a_known_rotation(world):
    twist = torch.tensor([0.006, -0.008, 0.004, 0.0, 0.0, 0.0]).double()
    views = list(world.observations.views)
    tilted = views[2].camera.world_from_camera @ rigid_from_tangent(twist)
    views[2] = replace(views[2], camera=views[2].camera.at(tilted))
    observations = replace(world.observations, views=tuple(views))
    start = scene_of(
        world.scene.gaussians, [view.camera for view in views], world.observations.tracks
    )
    frozen = (1e-9, 1e-9)
    config = short_fit(
        steps=240,
        half_resolution=0.0,
        densification=DensificationConfig(budget=5000, start=0.0, stop=0.0),
        refinement=RefinementConfig(start_step=0, actors=False),
        learning_rates=LearningRates(
            means=frozen,
            rotation_wxyz=frozen,
            log_scale=frozen,
            opacity_logit=frozen,
            sh_dc=frozen,
            sh_rest=frozen,
            camera_rotation_rad=(1e-3, 5e-5),
            camera_translation_m=(1e-6, 1e-6),
        ),
    )
    fitted = fit_gaussians(observations, config, start=start).scene
    corrected = fitted.refined_camera(views[2])
    true = world.observations.views[2].camera.world_from_camera
    left_over = true[:3, :3].T @ corrected.world_from_camera[:3, :3]
    angle_rad = float((left_over - torch.eye(3).double()).norm()) / 2**0.5
    assert angle_rad < 0.1 * float(twist.norm())


def with_guidance_gradients(world, view, config, perceptual=None):
    """A state and its leaves after the gradients of one painted view."""
    state = FitState.begin(world.scene, config, WIDTH_PX * HEIGHT_PX, perceptual)
    posed = state.scene.posed_in_fit(view.camera, view.timestamp_ns)
    seen = state.seen({~0: posed.looks()})
    add_guidance_gradients(state, seen, view, posed)
    return state, seen


def test_painted_views_move_geometry_and_colour(world):
    _, seen = with_guidance_gradients(world, painted_view(world), short_fit())
    assert float(seen.means.grad.abs().sum()) > 0
    assert float(seen.sh.grad.abs().sum()) > 0


def test_the_threads_of_a_step_share_no_leaf(world, monkeypatch):
    """Where two threads meet one, each may come to wait for what the other holds."""
    made = []

    def one_after_the_other(first, second, _device):
        made.extend(work.args[1] for work in (first, second))
        return first(), second()

    monkeypatch.setattr(step, "both", one_after_the_other)
    state = FitState.begin(world.scene, short_fit(), WIDTH_PX * HEIGHT_PX)
    image = full_image(world.observations.views[0])
    fit_step(state, image, 0, (0, painted_view(world)))
    ours, theirs = made
    for name, value in ours.values().items():
        assert getattr(ours, name) is not getattr(theirs, name)
        assert getattr(theirs, name).is_leaf
        assert value.data_ptr() == theirs.values()[name].data_ptr()


def test_gradients_of_both_views_count(world):
    view, config = painted_view(world), short_fit()
    _, alone = with_guidance_gradients(world, view, config)
    _, seen = with_guidance_gradients(world, view, config)
    twin = seen.twin()
    assert all(not gradient.any() for gradient in twin.gradients().values())
    twin.take_gradients_of(seen)
    seen.take_gradients_of(twin)
    for name, gradient in alone.gradients().items():
        assert torch.equal(seen.gradients()[name], 2 * gradient)


def test_painted_views_pull_the_scene_towards_them(world):
    guided = replace(
        continuation(short_fit(), guidance=GuidanceConfig(probability=1.0, weight=3.0)), steps=60
    )
    start = world.scene
    painted = painted_view(world)
    with_guidance = fit_gaussians(world.observations, guided, start=start, guidance=[painted]).scene
    without = fit_gaussians(world.observations, guided, start=start).scene
    errors = [
        float((scene.render(painted.camera, FRAME_NS).rgb - painted.rgb).abs().mean())
        for scene in (with_guidance, without)
    ]
    assert errors[0] < errors[1] - 0.02


def test_painted_and_recorded_views_beside_each_other_make_the_fit_of_one_thread(world):
    guided = replace(
        continuation(short_fit(), guidance=GuidanceConfig(probability=1.0, weight=3.0)), steps=20
    )
    before, fitted = numba.get_num_threads(), []
    try:
        for threads in (1, numba.config.NUMBA_NUM_THREADS):
            numba.set_num_threads(threads)
            fitted.append(
                fit_gaussians(
                    world.observations, guided, start=world.scene, guidance=[painted_view(world)]
                )
            )
    finally:
        numba.set_num_threads(before)
    assert_same_scene(*(found.scene for found in fitted))


def test_untrusted_painted_view_changes_nothing(world):
    config = short_fit(guidance=GuidanceConfig(depth=0.0))
    _, seen = with_guidance_gradients(world, painted_view(world, weight=0.0), config)
    assert float(seen.sh.grad.abs().sum()) == 0


def test_what_lidar_hit_on_painted_views_becomes_more_opaque_alone(world):
    config = short_fit(guidance=GuidanceConfig(depth=0.0))
    view = painted_view(world, weight=0.0, lidar_m=7.0)
    _, seen = with_guidance_gradients(world, view, config)
    assert (seen.opacity_logit.grad <= 0).all()  # a step goes against it
    assert (seen.opacity_logit.grad < 0).any()
    assert float(seen.sh.grad.abs().sum()) == 0


def squared_distance(image, truth):
    return 100.0 * (image - truth).square().mean()


def test_perceptual_distance_counts_on_painted_views_as_far_as_they_are_trusted(world):
    config = short_fit(guidance=GuidanceConfig(depth=0.0, perceptual=1.0))
    gradients = []
    for weight, perceptual in ((1.0, None), (1.0, squared_distance), (0.0, squared_distance)):
        view = painted_view(world, weight=weight)
        _, seen = with_guidance_gradients(world, view, config, perceptual)
        gradients.append(float(seen.sh.grad.abs().sum()))
    assert gradients[1] > 1.5 * gradients[0] > 0
    assert gradients[2] == 0


def test_perceptual_distance_counts_on_recorded_views(world, undisturbed):
    config = short_fit(losses=replace(short_fit().losses, perceptual=1.0))
    fitted = fit_gaussians(world.observations, config, perceptual=squared_distance)
    assert fitted.history[0]["loss"] > 1.1 * undisturbed.history[0]["loss"]
    assert fitted.scene.num_gaussians > 0


def test_start_of_other_views_is_refused(world):
    start = scene_of(world.scene.gaussians, [world.observations.views[0].camera])
    with pytest.raises(ConfigError, match="other training views"):
        fit_gaussians(world.observations, short_fit(), start=start)


def test_perceptual_weight_without_a_distance_is_refused(world):
    config = short_fit(losses=replace(short_fit().losses, perceptual=0.1))
    with pytest.raises(ConfigError, match="perceptual"):
        fit_gaussians(world.observations, config)


def test_a_fit_out_of_time_ends_early_with_schedules_of_as_many_steps(world, monkeypatch):
    ends, end = [], fit_module._finished
    monkeypatch.setattr(fit_module, "_finished", lambda state: ends.append(state) or end(state))
    found = fit_gaussians(world.observations, short_fit(log_every=4, time_limit_s=1e-9))
    assert found.history[-1]["step"] == 4
    assert found.scene.num_gaussians > 0
    assert ends[0].steps == ends[0].step == 4


def test_a_fit_tells_its_plan_first_and_how_far_it_is(world, undisturbed):
    told, looks = [], []

    class EveryTenth:
        def is_due(self, share_of_steps):
            return round(10 * share_of_steps, 9).is_integer()

        def show(self, scene):
            looks.append((told[-1].step, scene.num_gaussians > 0))

    found = fit_gaussians(
        world.observations, short_fit(), progress=told.append, onlooker=EveryTenth()
    )
    assert looks == [(tenth * STEPS // 10, True) for tenth in range(1, 11)]
    assert told[0].step == told[0].share == 0.0
    assert {now.plan for now in told} == {found.plan}
    assert found.plan.numbers()["most_gaussians"] == 900
    steps = [now for now in told if now.step]
    assert [now.step for now in steps] == list(range(1, STEPS + 1))
    shares = [now.share for now in steps]
    assert shares == sorted(shares)
    assert max(shares[:-1]) < shares[-1] == 1.0
    assert_same_scene(found.scene, undisturbed.scene)


def test_a_limit_that_is_not_reached_changes_nothing(world, undisturbed):
    found = fit_gaussians(world.observations, short_fit(time_limit_s=1e9))
    assert_same_scene(found.scene, undisturbed.scene)
