"""Actors that grow bright and dark over time."""

import torch
from gaussian_world import FRAME_NS, round_gaussians

from lidarpainter_models.gaussians.model.actor_light import ActorLight
from lidarpainter_models.gaussians.model.seen_gaussians import SeenGaussians

RGB = torch.tensor([[0.5, 0.4, 0.3], [0.2, 0.4, 0.6]])


def street_and_car():
    own = round_gaussians(torch.zeros(2, 3), RGB, sigma_m=0.1)
    return own.of_body(0).select(torch.tensor([0])).append(own.of_body(1).select(torch.tensor([1])))


def twice_as_bright_at_the_end():
    steady = ActorLight.steady(1, torch.tensor([0, FRAME_NS]))
    steady.log_gain[1] = torch.tensor([2.0]).log()
    return steady


def test_a_body_takes_the_gain_of_its_time_and_the_street_none():
    light, scene = twice_as_bright_at_the_end(), street_and_car()
    for when, gain in ((0, 1.0), (FRAME_NS // 2, 2.0**0.5), (FRAME_NS, 2.0), (9 * FRAME_NS, 2.0)):
        shown = light.lit(scene, when)
        assert torch.allclose(shown.base_rgb[1], gain * RGB[1], atol=1e-5)
        assert torch.equal(shown.base_rgb[0], scene.base_rgb[0])


def test_who_stays_as_bright_keeps_every_bit():
    scene = street_and_car()
    shown = ActorLight.steady(1, torch.tensor([0, FRAME_NS])).lit(scene, FRAME_NS // 3)
    assert torch.equal(shown.sh_dc, scene.sh_dc)
    assert torch.equal(shown.sh_rest, scene.sh_rest)
    assert ActorLight.steady(0, torch.tensor([0])).lit(scene, 0) is scene


def test_harmonics_in_one_tensor_are_lit_alike():
    light, scene = twice_as_bright_at_the_end(), street_and_car()
    both = SeenGaussians.of(scene, torch.cat([scene.sh_dc, scene.sh_rest], dim=1))
    shown, alike = light.lit(scene, FRAME_NS), light.lit(both, FRAME_NS)
    assert torch.allclose(alike.sh, torch.cat([shown.sh_dc, shown.sh_rest], dim=1))


def test_actors_come_and_go_with_their_light():
    light = twice_as_bright_at_the_end().with_steady()
    assert light.log_gain.shape == (2, 2, 3)
    assert float(light.log_gain[:, 1].abs().sum()) == 0
    assert torch.equal(light.kept([1]).log_gain, light.log_gain[:, 1:])
