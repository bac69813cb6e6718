"""Lamps: which Gaussians they light, when, and what follows them."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import FRAME_NS, round_gaussians
from styled_world import START_M, camera_above, styled

from lidarpainter_models.gaussians.model.blinking import NUM_NODES, Blinking, with_added_colour
from lidarpainter_models.gaussians.model.gaussian_set import SH_CONSTANT
from lidarpainter_models.gaussians.model.stored_scene import (
    copy_scene,
    scene_from_arrays,
    scene_to_arrays,
)

KNOTS_NS = torch.tensor([0, 100, 300]) * 1_000_000
RED = torch.tensor([0.5, 0.1, 0.0])


def lamps(bodies, centres_m, is_lit):
    """Lamps of 0.4 m that add the same red everywhere in them."""
    return Blinking(
        bodies=torch.tensor(bodies),
        centre_m=torch.tensor(centres_m),
        size_m=torch.full((len(bodies), 3), 0.4),
        lit_rgb=RED.expand(len(bodies), NUM_NODES, 3).clone(),
        knots_ns=KNOTS_NS,
        is_lit=torch.tensor(is_lit),
    )


def two_lamps():
    """One of the street that goes on, one of the second actor that goes off."""
    return lamps([0, 2], [[5.0, 0.0, 1.0], [-2.0, 0.6, 0.0]], [[0.0, 1.0], [1.0, 1.0], [1.0, 0.0]])


def gaussians(places, body):
    return round_gaussians(
        torch.tensor(places), torch.full((len(places), 3), 0.2), sigma_m=0.05, body=body
    )


def added(blinking, some, timestamp_ns):
    return (blinking.lit(some, timestamp_ns).sh_dc - some.sh_dc)[:, 0] * SH_CONSTANT


def test_a_lamp_lights_what_is_in_its_box_and_of_its_body():
    places = [[5.1, 0.1, 0.9], [5.3, 0.0, 1.0], [-2.0, 0.6, 0.0]]
    street = added(two_lamps(), gaussians(places, 0), 200_000_000)
    assert torch.allclose(street, torch.stack([RED, 0 * RED, 0 * RED]), atol=1e-6)
    actor = added(two_lamps(), gaussians(places, 2), 100_000_000)
    assert torch.allclose(actor, torch.stack([0 * RED, 0 * RED, RED]), atol=1e-6)
    assert not added(two_lamps(), gaussians(places, 1), 100_000_000).any()


def test_lamps_are_named_by_whose_they_are():
    of_both = two_lamps().in_words(["car-001", "car-002"])
    assert of_both == [
        "Lamps go on and off (1 of the street, 1 of car-002): shown on when they were."
    ]
    assert Blinking.none().in_words(["car-001"]) == []


@pytest.mark.parametrize(
    ("time_ms", "share"), [(-50, 0.0), (0, 0.0), (25, 0.25), (100, 1.0), (300, 1.0), (900, 1.0)]
)
def test_between_knots_a_lamp_is_partly_on_and_beyond_them_as_at_the_last(time_ms, share):
    lit = added(two_lamps(), gaussians([[5.0, 0.0, 1.0]], 0), time_ms * 1_000_000)
    assert torch.allclose(lit[0], share * RED, atol=1e-6)


def test_what_is_off_leaves_the_gaussians_as_they_are():
    some = gaussians([[5.0, 0.0, 1.0]], 0)
    assert two_lamps().lit(some, 0) is some
    assert Blinking.none().lit(some, 0) is some


def test_two_lamps_that_overlap_add_up():
    both = lamps([0, 0], [[5.0, 0.0, 1.0], [5.1, 0.0, 1.0]], [[1.0, 1.0]] * 3)
    assert torch.allclose(added(both, gaussians([[5.05, 0, 1]], 0), 0)[0], 2 * RED, atol=1e-6)


def test_gradients_pass_through_to_the_colours():
    some = gaussians([[5.0, 0.0, 1.0], [9.0, 0.0, 1.0]], 0).as_leaves()
    two_lamps().lit(some, FRAME_NS).sh_dc.sum().backward()
    assert torch.equal(some.sh_dc.grad, torch.ones(2, 1, 3))


def test_lamps_go_with_their_body():
    rest = two_lamps().without(1)
    assert rest.bodies.tolist() == [0, 1]
    assert torch.allclose(added(rest, gaussians([[-2.0, 0.6, 0.0]], 1), 0)[0], RED, atol=1e-6)
    gone = two_lamps().without(2)
    assert gone.bodies.tolist() == [0]
    assert gone.lit_at(0).tolist() == [0.0]
    assert len(two_lamps().of_others(2)) == len(gone)


def test_lamps_are_drawn_and_stored_as_they_are_then(world):
    scene = copy_scene(world.scene)
    place = scene.gaussians.means[scene.gaussians.body_index == 0].mean(dim=0)
    lamp = replace(
        lamps([0], [place.tolist()], [[0.0], [1.0], [1.0]]), size_m=torch.full((1, 3), 2.0)
    )
    scene = replace(scene, blinking=lamp)
    camera = world.observations.views[0].camera
    dark, lit = (scene.render(camera, time_ns).rgb for time_ns in (0, FRAME_NS))
    assert torch.equal(dark, world.scene.render(camera, 0).rgb)
    assert float((lit - world.scene.render(camera, FRAME_NS).rgb).max()) > 0.2
    again = scene_from_arrays(*scene_to_arrays(scene))
    assert torch.equal(again.render(camera, FRAME_NS).rgb, lit)


def test_colour_is_added_to_the_constant_harmonic_alone():
    some = gaussians([[5.0, 0.0, 1.0], [9.0, 0.0, 1.0]], 0)
    lit = with_added_colour(some, torch.tensor([1]), RED[None])
    assert torch.allclose(lit.base_rgb - some.base_rgb, torch.stack([0 * RED, RED]), atol=1e-6)
    assert torch.equal(lit.sh_rest, some.sh_rest)


def test_what_has_no_time_is_lit_on_average():
    lit = two_lamps().lit_on_average(gaussians([[5.0, 0.0, 1.0]], 0))
    assert torch.allclose(lit.base_rgb[0], 0.2 + 2 / 3 * RED, atol=1e-6)


def test_a_scene_in_a_style_keeps_its_lamps():
    scene = styled("rain")
    lamp = replace(
        lamps([1], [[0.0, 0.0, 0.0]], [[0.0], [1.0], [1.0]]), size_m=torch.full((1, 3), 9.0)
    )
    camera = camera_above(START_M)
    lit, off = (
        replace(scene, blinking=blinking).render(camera, FRAME_NS).rgb
        for blinking in (lamp, scene.blinking)
    )
    assert float((lit - off).max()) > 0.1
