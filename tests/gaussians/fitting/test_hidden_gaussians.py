"""What a view's image does not show is left out of its next steps, and nothing else is."""

import pytest
import torch
from gaussian_world import HEIGHT_PX, WIDTH_PX, camera_at, round_gaussians, scene_of

from lidarpainter_models.gaussians.fitting.config import FitConfig, RefinementConfig
from lidarpainter_models.gaussians.fitting.hidden_gaussians import (
    LEAST_PX,
    LOOKS,
    PROBE,
    HiddenGaussians,
    probed,
)
from lidarpainter_models.gaussians.fitting.images import full_image
from lidarpainter_models.gaussians.fitting.state import FitState
from lidarpainter_models.gaussians.fitting.step import fit_step
from lidarpainter_models.gaussians.model.scene_rendering import camera_from_body, draw_gaussians
from lidarpainter_models.observations.views import TrainingView

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


def test_a_view_looks_at_everything_first_and_every_few_looks():
    hidden = HiddenGaussians.none_yet(5, CPU)
    at_everything = []
    for _ in range(2 * LOOKS + 1):
        is_due = hidden.is_due(0)
        assert (hidden.probe(0, 5) is not None) == is_due
        at_everything.append(is_due)
        assert left_out(hidden, 0) == ([] if is_due else [1, 3])
        hidden.learn(0, torch.arange(5), filled([1, 3], 5) if is_due else None)
    assert [k for k, is_due in enumerate(at_everything) if is_due] == [0, LOOKS, 2 * LOOKS]


def test_views_leave_out_what_they_do_not_show_themselves():
    hidden = HiddenGaussians.none_yet(4, CPU)
    hidden.learn(0, torch.arange(4), filled([0], 4))
    hidden.learn(~0, torch.arange(1, 4), filled([2], 3))
    assert left_out(hidden, 0) == [0]
    assert left_out(hidden, ~0) == [3]
    assert left_out(hidden, 1) == []


def test_the_least_that_is_looked_at():
    hidden = HiddenGaussians.none_yet(2, CPU)
    hidden.learn(0, torch.arange(2), collected(LEAST_PX * 0.99, LEAST_PX * 1.01))
    assert left_out(hidden, 0) == [0]


@pytest.mark.parametrize("seed", range(5))
def test_numbers_follow_every_change_of_the_set(seed):
    """Against names that are carried along by hand."""
    generator = torch.Generator().manual_seed(seed)
    hidden, names = HiddenGaussians.none_yet(20, CPU), list(range(20))
    listed = [3, 8, 15]
    hidden.learn(0, torch.arange(20), filled(listed, 20))
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
    hidden.learn(2, torch.arange(6), filled([1], 6))
    hidden.learn(~1, torch.arange(6), filled([4, 5], 6))
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
    return scene, camera, camera_from_body(camera.world_from_camera, *scene.actors.likely_poses(0))


def test_a_probe_measures_the_pixels_that_each_gaussian_fills():
    scene, camera, bodies = wall_and_what_is_behind()
    probe = ones(4)
    image = draw_gaussians(scene.gaussians, bodies, camera, channel=probe)
    probed(image, probe).backward()
    px = probe.grad[:, 0] / PROBE
    assert float(px.sum()) == pytest.approx(float(image.alpha.detach().sum()), rel=1e-4)
    assert float(px[0]) > 0.9 * WIDTH_PX * HEIGHT_PX
    assert float(px[2]) < 0.001 * float(px[3])


def test_a_probe_beside_the_actors_changes_no_image():
    scene, camera, bodies = wall_and_what_is_behind()
    plain = draw_gaussians(scene.gaussians, bodies, camera, with_actor_alpha=True)
    probed = draw_gaussians(scene.gaussians, bodies, camera, with_actor_alpha=True, channel=ones(4))
    assert torch.equal(plain.rgb, probed.rgb)
    assert torch.equal(plain.features[..., 0], probed.features[..., 0])
    torch.testing.assert_close(probed.features[..., 1], probed.alpha, atol=1e-5, rtol=0)


def test_steps_leave_out_what_is_behind_a_wall_until_everything_is_looked_at():
    scene, camera, bodies = wall_and_what_is_behind()
    config = FitConfig(steps=100, refinement=RefinementConfig(start_step=100))
    state = FitState.begin(scene, config, WIDTH_PX * HEIGHT_PX)
    image = full_image(
        TrainingView(
            key=(0, "front"),
            camera=camera,
            timestamp_ns=0,
            rgb_u8=torch.full((HEIGHT_PX, WIDTH_PX, 3), 99, dtype=torch.uint8),
            sky_mask=torch.zeros(HEIGHT_PX, WIDTH_PX, dtype=torch.bool),
            lidar_depth_m=torch.zeros(HEIGHT_PX, WIDTH_PX),
        )
    )
    looked_at = []
    for _ in range(LOOKS + 1):
        looked_at.append(len(state.seen({0: [(camera, bodies)]})))
        fit_step(state, image, 0, None, config, None)
        state.step += 1
    assert looked_at == [4, *[3] * (LOOKS - 1), 4]
    assert len(state.seen({1: [(camera, bodies)]})) == 4
