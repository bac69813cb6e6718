"""A box that holds the recording car is ignored and named, whatever else its track holds."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.checks.actors import check_own_boxes
from lidarpainter_models.scenes.driving_scene import driven_road
from lidarpainter_models.scenes.own_boxes import own_places, without_own_boxes


def around_the_car(scene, size_m, *, height_m=0.8, rows=slice(None)):
    """A track of boxes around the recording car, in the frames of some rows."""
    poses = scene.world_from_ego[rows].clone()
    poses[:, :3, 3] += height_m * poses[:, :3, 2]
    return replace(
        scene.tracks[0],
        actor_id="ego",
        size_m=torch.tensor(size_m),
        is_moving=True,
        frame_indices=torch.tensor(scene.frame_indices[rows]),
        timestamps_ns=scene.frame_timestamps_ns[rows],
        world_from_box=poses,
        num_points=torch.zeros(len(poses), dtype=torch.int64),
    )


def without(scene, *tracks):
    ego = driven_road(scene)
    places = own_places(scene.views, scene.sweeps, ego)
    return without_own_boxes((*scene.tracks, *tracks), places, ego)


@pytest.mark.parametrize("size_m", [(4.8, 2.0, 1.7), (14.0, 8.0, 4.0)], ids=["car", "far larger"])
def test_a_box_around_the_car_is_left_out_and_named(small_scene, size_m):
    kept, own = without(small_scene, around_the_car(small_scene, size_m))
    assert [track.actor_id for track in kept] == [t.actor_id for t in small_scene.tracks]
    assert [(one.actor_id, one.num_boxes) for one in own] == [("ego", 3)]


def test_boxes_of_others_stay_as_they_are(small_scene):
    kept, own = without(small_scene)
    assert own == ()
    assert all(after is before for after, before in zip(kept, small_scene.tracks, strict=True))
    assert check_own_boxes(small_scene)[0] == "ok"


def test_one_box_that_holds_the_car_costs_its_track_no_other(small_scene):
    track = next(t for t in small_scene.tracks if len(t.timestamps_ns) == 3)
    poses = track.world_from_box.clone()
    row = small_scene.frame_position(int(track.frame_indices[1]))
    poses[1] = small_scene.world_from_ego[row]
    kept, own = without(small_scene, replace(track, actor_id="slips", world_from_box=poses))
    assert str(own[0]) == f"slips ({track.category}, 1 of 3 boxes)"
    assert kept[-1].timestamps_ns.tolist() == track.timestamps_ns[[0, 2]].tolist()
