from dataclasses import replace

import pytest
import torch
from gaussian_world import camera_at, car_track
from toy_street import ToyStreet

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.gaussians.fitting.images import full_image, half_image, shrink_depth
from lidarpainter_models.gaussians.initialisation.scene import initialise_scene
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.kernels.pixel_losses import OPEN, SKY, SOLID
from lidarpainter_models.lidar.points_on_actors import MovingBoxes
from lidarpainter_models.lidar.sparse_depth import sparse_lidar_depth
from lidarpainter_models.observations.image_shrinking import shrink_image
from lidarpainter_models.observations.preparation import prepare_observations
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.observations.stored_form import (
    observations_from_arrays,
    observations_to_arrays,
)
from lidarpainter_models.scenes.splits import split_views

FRAME_NS = 100_000_000


def test_stored_observations_are_the_same(world):
    arrays, metadata = observations_to_arrays(world.observations)
    again = observations_from_arrays(arrays, metadata)
    second_arrays, second_metadata = observations_to_arrays(again)
    assert metadata == second_metadata
    assert arrays.keys() == second_arrays.keys()
    assert all(torch.equal(value, second_arrays[name]) for name, value in arrays.items())
    assert again.tracks[0].actor_id == "car"


def test_observations_of_another_version_are_refused(world):
    arrays, metadata = observations_to_arrays(world.observations)
    with pytest.raises(SceneError, match="prepare them again"):
        observations_from_arrays(arrays, {**metadata, "schema": 0})


def test_every_training_image_is_decoded_once():
    street, read = ToyStreet(), []
    street.read_image = lambda view: read.append(view.key) or ToyStreet.read_image(street, view)
    split = split_views(street, "alternate")
    observations = prepare_observations(street, split, ObservationConfig(width_px=120))
    assert read == [view.key for view in split.train]
    assert [view.key for view in observations.views] == read
    points = observations.lidar_map.street
    assert sorted(points.frame_index.unique().tolist()) == [0]  # a car that stands
    assert float(points.has_colour.float().mean()) > 0.9


def test_images_know_how_they_show_the_colours_of_the_map():
    street = ToyStreet(camera_gains=(("front", 1.0), ("side", 0.8)))
    split = split_views(street, "alternate")
    observations = prepare_observations(street, split, ObservationConfig(width_px=120))
    by_camera = {"front": 1.0, "side": 0.8}
    for view in observations.views:
        assert view.exposure_rgb == pytest.approx([by_camera[view.key[1]]] * 3, rel=0.02)
    again = observations_from_arrays(*observations_to_arrays(observations))
    assert again.views[1].exposure_rgb == observations.views[1].exposure_rgb
    first = initialise_scene(observations, InitialisationConfig(num_gaussians=500))
    side = observations.views[1]
    shown = first.exposure.map_at("side", side.timestamp_ns)
    assert shown[:, :3].diag().tolist() == pytest.approx([0.8] * 3, rel=0.02)
    sky = first.sky.sample(first.sky.rays(side.camera))[side.sky_mask]
    taken = side.rgb[side.sky_mask]
    assert (0.8 * sky.mean(dim=0)).tolist() == pytest.approx(taken.mean(dim=0).tolist(), rel=0.03)


def test_image_is_averaged_by_area():
    image = torch.tensor([[0, 100], [200, 100]], dtype=torch.uint8)[..., None].expand(2, 2, 3)
    small = shrink_image(image.contiguous(), width_px=1, height_px=1)
    assert small.flatten().tolist() == [100, 100, 100]


def test_tiny_fit_images_are_refused():
    with pytest.raises(ConfigError, match="width_px"):
        ObservationConfig(width_px=8)


def test_nearest_point_of_a_pixel_gives_its_depth():
    camera = camera_at(0.0)
    points = torch.tensor([[10.0, 0.05, 1.05], [5.0, 0.025, 1.025], [-5.0, 0, 1.0]])
    depth_m = sparse_lidar_depth(points, camera)
    assert int((depth_m > 0).sum()) == 1
    assert abs(float(depth_m.max()) - 5.0) < 1e-5


def test_point_seen_past_the_edge_of_a_nearer_thing_is_dropped():
    camera = camera_at(0.0)
    wall = torch.tensor([[20.0, 0.8, 0.9]])  # two pixels beside the post
    post = torch.tensor([[5.0, 0.025, 1.025]])
    both = sparse_lidar_depth(torch.cat([wall, post]), camera)
    assert both[both > 0].tolist() == pytest.approx([5.0])
    alone = sparse_lidar_depth(wall, camera)
    assert alone[alone > 0].tolist() == pytest.approx([20.0])


def test_grazing_surface_keeps_its_points():
    camera = camera_at(0.0)
    road = torch.stack([torch.arange(4, 40, 0.25), torch.zeros(144), torch.zeros(144)], dim=1)
    depth_m = sparse_lidar_depth(road, camera)
    rows = (depth_m > 0).any(dim=1)
    assert int(rows.sum()) >= 8


def test_empty_sweep_gives_empty_depth():
    depth_m = sparse_lidar_depth(torch.zeros(0, 3), camera_at(0.0))
    assert float(depth_m.abs().max()) == 0


def test_points_inside_a_moving_box_go_with_it():
    boxes = MovingBoxes([car_track(4)])
    points = torch.tensor([[6.0, -2.0, 0.6], [6.0, 3.0, 0.6]])
    moved, _ = boxes.moved(points, boxes.owners(points, 0), from_ns=0, to_ns=2 * FRAME_NS)
    assert torch.allclose(moved, torch.tensor([[6.0, 0.0, 0.6], [6.0, 3.0, 0.6]]), atol=1e-5)


def test_half_size_keeps_the_nearest_depth_of_each_cell():
    depth_m = torch.tensor([[4.0, 0.0, 0.0], [2.0, 9.0, 0.0]])
    small = shrink_depth(depth_m, width_px=1, height_px=1)
    assert small.tolist() == [[2.0]]


def test_pixels_are_told_apart(world):
    view = world.observations.views[0]
    for image in (full_image(view), half_image(view)):
        kind = image.kind
        assert kind.shape == (image.camera.height_px, image.camera.width_px)
        assert {int(value) for value in kind.unique()} <= {0, SKY, SOLID, OPEN}
    assert bool((full_image(view).kind[view.sky_mask] == SKY).all())


def test_only_where_some_view_has_sky_can_a_pixel_be_open(world):
    nowhere = torch.zeros_like(world.observations.views[0].sky_mask)
    view = replace(world.observations.views[0], sky_mask=nowhere)
    for make in (full_image, half_image):
        kind, kind_without = make(view).kind, make(view, nowhere).kind
        assert bool((kind == OPEN).any())
        assert not bool((kind_without == OPEN).any())
        assert torch.equal(kind[kind != OPEN], kind_without[kind != OPEN])
