"""What a view's image does not show is left out of its next steps, and nothing else is."""

import pytest
import torch
from gaussian_world import HEIGHT_PX, WIDTH_PX, camera_at, round_gaussians, scene_of, training_view

from lidarpainter_models.gaussians.fitting.config import FitConfig, RefinementConfig
from lidarpainter_models.gaussians.fitting.images import full_image
from lidarpainter_models.gaussians.fitting.occlusion_culling import (
    FIRST_LOOKS,
    LEAST_PX,
    LOOKS_BETWEEN,
    PROBE,
    HiddenGaussians,
    probed,
)
from lidarpainter_models.gaussians.fitting.state import FitState
from lidarpainter_models.gaussians.fitting.step import fit_step
from lidarpainter_models.gaussians.model.drawing import camera_from_body, draw_gaussians
from lidarpainter_models.observations.views import GuidanceView

CPU = torch.device("cpu")
SHOWN, HIDDEN = 10.0, 0.0


def collected(*filled_px):
    """A probe that found Gaussians to fill so many pixels."""
    probe = torch.ones(len(filled_px), 1, requires_grad=True)
    probe.grad = PROBE * torch.tensor(filled_px)[:, None]
    return probe


def filled(hidden_rows, count):
    return collected(*(HIDDEN if row in hidden_rows else SHOWN for row in range(count)))


def ones(count):
    return HiddenGaussians.none_yet(count, CPU).probe(0, count)


def left_out(hidden, view):
    everything = torch.ones(len(hidden.number), dtype=torch.bool)
    return (~hidden.without(everything, view)).nonzero()[:, 0].tolist()


def look_at_everything(hidden, view, rows, probe, in_view=None):
    everything = torch.ones(len(hidden.number), dtype=torch.bool)
    hidden.without(everything if in_view is None else in_view, view)
    hidden.learn(view, rows, probe)


def test_a_view_looks_at_everything_at_first_and_now_and_then():
    hidden = HiddenGaussians.none_yet(5, CPU)
    at_everything = []
    for look in range(FIRST_LOOKS[-1] + 2 * LOOKS_BETWEEN + 1):
        is_due = hidden.is_due(0)
        if is_due:
            at_everything.append(look)
        assert (hidden.probe(0, 5) is not None) == is_due
        assert left_out(hidden, 0) == ([] if is_due else [1, 3])
        hidden.learn(0, torch.arange(5), filled([1, 3], 5) if is_due else None)
    later = [FIRST_LOOKS[-1] + k * LOOKS_BETWEEN for k in (1, 2)]
    assert at_everything == [*FIRST_LOOKS, *later]


def test_views_leave_out_what_they_do_not_show_themselves():
    hidden = HiddenGaussians.none_yet(4, CPU)
    look_at_everything(hidden, 0, torch.arange(4), filled([0], 4))
    look_at_everything(hidden, ~0, torch.arange(1, 4), filled([2], 3))
    assert left_out(hidden, 0) == [0]
    assert left_out(hidden, ~0) == [3]
    assert left_out(hidden, 1) == []


def test_nothing_is_said_of_what_another_view_brought_along():
    hidden = HiddenGaussians.none_yet(4, CPU)
    in_view = torch.tensor([True, True, False, False])
    look_at_everything(hidden, 0, torch.arange(4), filled([1, 3], 4), in_view)
    assert left_out(hidden, 0) == [1]


def test_the_least_that_is_looked_at():
    hidden = HiddenGaussians.none_yet(2, CPU)
    look_at_everything(hidden, 0, torch.arange(2), collected(LEAST_PX * 0.99, LEAST_PX * 1.01))
    assert left_out(hidden, 0) == [0]


@pytest.mark.parametrize("seed", range(5))
def test_numbers_follow_every_change_of_the_set(seed):
    """Against names that are carried along by hand."""
    generator = torch.Generator().manual_seed(seed)
    hidden, names = HiddenGaussians.none_yet(20, CPU), list(range(20))
    listed = [3, 8, 15]
    look_at_everything(hidden, 0, torch.arange(20), filled(listed, 20))
    for _ in range(4):
        is_kept = torch.rand(len(names), generator=generator) < 0.7
        kept = is_kept.nonzero()[:, 0]
        num_added = int(torch.randint(0, 6, (), generator=generator))
        hidden.follow(kept, num_added)
        names = [names[row] for row in kept.tolist()] + [None] * num_added
        expected = [row for row, name in enumerate(names) if name in listed]
        assert left_out(hidden, 0) == expected


def test_kept_state_is_taken_up_again():
    hidden = HiddenGaussians.none_yet(6, CPU)
    look_at_everything(hidden, 2, torch.arange(6), filled([1], 6))
    look_at_everything(hidden, ~1, torch.arange(6), filled([4, 5], 6))
    hidden.learn(2, torch.arange(6), None)
    hidden.follow(torch.tensor([1, 2, 4]), 2)
    again = HiddenGaussians.from_tensors(hidden.tensors(), CPU)
    assert again.looks == hidden.looks
    for view in (2, ~1, 0):
        assert left_out(again, view) == left_out(hidden, view)
    again.follow(torch.arange(5), 1)
    assert int(again.number.unique().numel()) == 6


def test_a_fresh_state_can_be_kept():
    again = HiddenGaussians.from_tensors(HiddenGaussians.none_yet(3, CPU).tensors(), CPU)
    assert again.is_due(0)
    assert again.number.tolist() == [0, 1, 2]


def wall_and_what_is_behind():
    """Two opaque Gaussians that fill the image, one behind them and one before them."""
    means = torch.tensor([[10.0, 0.0, 1.5], [12.0, 0.0, 1.5], [20.0, 0.0, 1.5], [5.0, 0.0, 1.5]])
    gaussians = round_gaussians(means, torch.rand(4, 3), sigma_m=0.1)
    gaussians.log_scale[:2] = 3.0
    gaussians.opacity_logit[:2] = 12.0
    camera = camera_at(0.0)
    scene = scene_of(gaussians, [camera])
    return scene, camera, camera_from_body(camera.world_from_camera, *scene.actors.refined_poses(0))


def test_a_probe_measures_the_pixels_that_each_gaussian_fills():
    scene, camera, bodies = wall_and_what_is_behind()
    probe = ones(4)
    image = draw_gaussians(scene.gaussians, bodies, camera, channels=probe)
    probed(image).backward()
    px = probe.grad[:, 0] / PROBE
    assert float(px.sum()) == pytest.approx(float(image.alpha.detach().sum()), rel=1e-4)
    assert float(px[0]) > 0.9 * WIDTH_PX * HEIGHT_PX
    assert float(px[2]) < 0.001 * float(px[3])


def test_a_probe_beside_the_actors_changes_no_image():
    scene, camera, bodies = wall_and_what_is_behind()
    plain = draw_gaussians(scene.gaussians, bodies, camera, with_actor_alpha=True)
    measured = draw_gaussians(
        scene.gaussians, bodies, camera, with_actor_alpha=True, channels=ones(4)
    )
    assert torch.equal(plain.rgb, measured.rgb)
    assert torch.equal(plain.features[..., 0], measured.features[..., 0])
    torch.testing.assert_close(measured.features[..., 1], measured.alpha, atol=1e-5, rtol=0)


def image_of(camera, **changes):
    grey = torch.full((HEIGHT_PX, WIDTH_PX, 3), 99, dtype=torch.uint8)
    return full_image(training_view(camera, rgb_u8=grey, **changes))


def begun(scene):
    config = FitConfig(steps=100, refinement=RefinementConfig(start_step=100))
    return FitState.begin(scene, config, WIDTH_PX * HEIGHT_PX)


def test_steps_leave_out_what_is_behind_a_wall_until_everything_is_looked_at():
    scene, camera, bodies = wall_and_what_is_behind()
    state = begun(scene)
    looked_at = []
    for _ in range(FIRST_LOOKS[1] + 1):
        looked_at.append(len(state.seen({0: [(camera, bodies)]})))
        fit_step(state, image_of(camera), 0)
        state.step += 1
    assert looked_at == [4, *[3] * (FIRST_LOOKS[1] - 1), 4]
    assert len(state.seen({1: [(camera, bodies)]})) == 4


def test_a_painted_view_keeps_a_list_of_its_own():
    scene, camera, _ = wall_and_what_is_behind()
    state = begun(scene)
    aside = camera_at(1.0)
    whole = torch.ones(HEIGHT_PX, WIDTH_PX)
    painted = GuidanceView.of(
        aside, 0, rgb=whole[..., None].expand(-1, -1, 3), weight=whole, lidar_depth_m=0 * whole
    )
    fit_step(state, image_of(camera), 0)
    fit_step(state, image_of(camera), 0, (7, painted))
    assert state.hidden.looks == {0: 2, ~7: 1}
    assert state.hidden.left_out[0].tolist() == state.hidden.left_out[~7].tolist() == [2]


def test_measuring_moves_nothing():
    """Adam makes whole steps of the smallest gradient that stands alone."""
    scene, camera, _ = wall_and_what_is_behind()
    state = begun(scene)
    before = {name: value.clone() for name, value in scene.gaussians.columns().items()}
    everything = torch.ones(HEIGHT_PX, WIDTH_PX, dtype=torch.bool)
    for _ in range(3):
        fit_step(state, image_of(camera, hidden=everything), 0)
        state.step += 1
    for name, value in state.caught_up().gaussians.columns().items():
        torch.testing.assert_close(value.detach(), before[name], rtol=0, atol=1e-5)
