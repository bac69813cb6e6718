from dataclasses import replace

import pytest
import torch
from gaussian_world import (
    CAR_SIZE_M,
    FRAME_NS,
    SKY_RGB,
    camera_at,
    car_track,
    round_gaussians,
    scene_of,
)

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.stored_scene import (
    copy_scene,
    scene_from_arrays,
    scene_to_arrays,
)


def one_gaussian(*, x_m=5.0, y_m=0.0, body=0):
    return round_gaussians(
        torch.tensor([[x_m, y_m, 1.0 if body == 0 else 0.0]]),
        torch.tensor([[1.0, 0.0, 0.0]]),
        sigma_m=0.3,
        body=body,
        opacity=0.99,
    )


def weighted_column(render):
    columns = torch.arange(render.alpha.shape[1]) + 0.5
    return float((render.actor_alpha.sum(0) * columns).sum() / render.actor_alpha.sum())


def test_one_gaussian_shows_in_the_middle_over_the_sky():
    camera = camera_at(0.0, width_px=65, height_px=49)
    render = scene_of(one_gaussian(), [camera]).render(camera, 0)
    assert torch.allclose(render.rgb[24, 32], torch.tensor([1.0, 0.0, 0.0]), atol=0.03)
    assert torch.allclose(render.rgb[0, 0], SKY_RGB, atol=1e-5)
    assert abs(float(render.depth_m[24, 32]) - 5.0) < 1e-3
    assert render.depth_m[0, 0] == 0
    assert float(render.actor_alpha.max()) == 0


def test_scene_without_gaussians_shows_the_sky():
    camera = camera_at(0.0)
    render = scene_of(GaussianSet.empty(), [camera]).render(camera, 0)
    assert torch.allclose(render.rgb, SKY_RGB.expand_as(render.rgb), atol=1e-5)
    assert float(render.alpha.max()) == 0


@pytest.mark.parametrize("body", [-1, 2])
def test_gaussians_of_a_body_that_is_not_there_are_refused(body):
    scene = scene_of(one_gaussian(body=body), [camera_at(0.0)], [car_track(2)])
    with pytest.raises(ShapeError, match="with 1 actors belong to bodies"):
        scene.render(camera_at(0.0), 0)


def test_actor_follows_its_pose_between_its_boxes_too():
    camera = camera_at(0.0)
    scene = scene_of(one_gaussian(x_m=0.0, body=1), [camera], [car_track(4)])
    for frame in (1, 1.5, 2, 3):
        render = scene.render(camera, int(frame * FRAME_NS))
        # mu = R_t mu_v + t_t with t_t = (6, frame - 2, 0.6); left in the world is left in the view
        expected = camera.fx_px * -(frame - 2.0) / 6.0 + camera.cx_px
        assert abs(weighted_column(render) - expected) < 0.2


def test_absent_actor_is_not_drawn():
    camera = camera_at(0.0)
    scene = scene_of(one_gaussian(x_m=0.0, body=1), [camera], [car_track(4)])
    assert float(scene.render(camera, 10 * FRAME_NS).alpha.max()) == 0


def test_corrected_actor_moves_in_its_box_frame():
    camera = camera_at(0.0)
    scene = scene_of(one_gaussian(x_m=0.0, body=1), [camera], [car_track(4)])
    before = weighted_column(scene.render(camera, 2 * FRAME_NS))
    scene.actors.tangent[:, :, 3] = 0.5  # ahead along its length, which points left
    after = weighted_column(scene.render(camera, 2 * FRAME_NS))
    assert abs((before - after) - camera.fx_px * 0.5 / 6.0) < 0.2
    moved = scene.tracks[0].world_from_box[2, :3, 3]
    assert torch.allclose(moved, torch.tensor([6.0, 0.5, 0.6]).double(), atol=1e-6)


def test_training_view_is_rendered_at_its_refined_pose(world):
    scene = copy_scene(world.scene)
    scene.cameras.view_tangent[1, 1] = 0.02
    camera = world.observations.views[1].camera
    as_recorded = scene.render(camera, FRAME_NS).rgb
    refined = scene.render(camera, FRAME_NS, view_key=(1, "front")).rgb
    moved = scene.refined_camera(world.observations.views[1])
    assert torch.equal(scene.render(moved, FRAME_NS).rgb, refined)
    assert (as_recorded - refined).abs().max() > 0.05


def test_exposure_changes_only_its_own_camera(world):
    scene = copy_scene(world.scene)
    scene.exposure.matrix[0, :, :3] *= 0.5
    camera = world.observations.views[0].camera
    plain = scene.render(camera, 0).rgb
    assert torch.allclose(scene.render(camera, 0, camera_name="front").rgb, plain / 2, atol=1e-6)
    assert torch.equal(scene.render(camera, 0, camera_name="side").rgb, plain)


def test_stored_scene_is_the_same_bit_for_bit(world):
    again = scene_from_arrays(*scene_to_arrays(world.scene))
    camera = world.observations.views[2].camera
    first, second = world.scene.render(camera, 2 * FRAME_NS), again.render(camera, 2 * FRAME_NS)
    assert torch.equal(first.rgb, second.rgb)
    assert torch.equal(again.actors.recorded_tracks[0].size_m, CAR_SIZE_M)


def test_who_walks_is_drawn_and_stored_as_they_stand_then(world):
    scene = copy_scene(world.scene)
    tracks, knots_ns = scene.actors.recorded_tracks, scene.actors.knots_ns
    scene = replace(scene, actors=Actors.uncorrected(tracks, knots_ns, bent=[0]))
    camera = world.observations.views[1].camera
    at_rest = scene.render(camera, FRAME_NS)
    assert torch.equal(at_rest.rgb, world.scene.render(camera, FRAME_NS).rgb)
    scene.actors.bending.offset_m[1, :, :, 2] = 0.3
    bent = scene.render(camera, FRAME_NS)
    lifted = [image.actor_alpha.nonzero()[:, 0].min() for image in (bent, at_rest)]
    assert lifted[0] < lifted[1]
    again = scene_from_arrays(*scene_to_arrays(scene))
    assert torch.equal(again.render(camera, FRAME_NS).rgb, bent.rgb)
    assert torch.equal(
        scene.render(camera, 3 * FRAME_NS).rgb, again.render(camera, 3 * FRAME_NS).rgb
    )


@pytest.mark.parametrize("group", ["bending", "blinking"])
def test_scenes_stored_before_people_walked_and_lamps_blinked_are_read(world, group):
    arrays, metadata = scene_to_arrays(world.scene)
    older = {name: value for name, value in arrays.items() if not name.startswith(group)}
    again = scene_from_arrays(older, metadata)
    assert not len(again.blinking)
    assert not len(again.actors.bending.bodies)
