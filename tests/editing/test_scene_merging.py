"""Two runs of one place become one: each spot is that run's which saw it more finely."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import (
    FRAME_NS,
    car_track,
    map_points,
    observe,
    round_gaussians,
    scene_of,
    turned_camera,
)

from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.editing.apply import edited
from lidarpainter_models.editing.filled_scenes import filled
from lidarpainter_models.editing.motions import LogTimes
from lidarpainter_models.editing.scene_merging import OtherRun
from lidarpainter_models.editing.script import Join, Remove
from lidarpainter_models.editing.worlds import EditedWorld
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.model.placing import carried_gaussians
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_tangent
from lidarpainter_models.lidar.lidar_map import LidarMap

RED, GREEN = torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.1, 0.8, 0.1])
WORLD_FROM_OTHER = rigid_from_tangent(torch.tensor([0, 0, 0.4, 3.0, -2.0, 0.1]).double())
SAME = torch.eye(4, dtype=torch.float64)
JOIN = Join(op="join", run="other")
NUM_FRAMES = 4


def run(rgb, yaw_rad, *, world_from_own=SAME, tracks=(), first_frame=0):
    """A wall of one colour 8 m ahead, all of it fitted, seen by a camera turned to the left."""
    y, z = torch.meshgrid(torch.arange(-14, 14, 0.3), torch.arange(-4, 5, 0.3), indexing="ij")
    wall_m = torch.stack([torch.full_like(y, 8.0), y, z], dim=-1).flatten(0, 1)
    gaussians = round_gaussians(wall_m, rgb.expand(len(wall_m), 3), sigma_m=0.2)
    for body, track in enumerate(tracks, start=1):
        inside_m = (torch.rand(80, 3, generator=torch.Generator().manual_seed(0)) - 0.5).mul(
            track.size_m
        )
        look = round_gaussians(inside_m, rgb.expand(80, 3), sigma_m=0.1, body=body)
        gaussians = gaussians.append(look)
    own_from_world = invert_rigid(world_from_own)
    is_wall = gaussians.body_index == 0
    wall = carried_gaussians(gaussians.select(is_wall.nonzero()[:, 0]), own_from_world)
    gaussians = wall.append(gaussians.select((~is_wall).nonzero()[:, 0]))
    tracks = [
        replace(track, world_from_box=own_from_world @ track.world_from_box) for track in tracks
    ]
    eye = turned_camera(yaw_rad)
    camera = eye.at(own_from_world @ eye.world_from_camera)
    times_ns = (first_frame + torch.arange(NUM_FRAMES)) * FRAME_NS
    scene = scene_of(gaussians, [camera] * NUM_FRAMES, tracks, timestamps_ns=times_ns)
    points = map_points(wall.means, rgb.expand(len(wall), 3))
    seen = observe(scene, [camera] * NUM_FRAMES, points, points)
    ego = DrivenPath(timestamps_ns=times_ns, world_from_body=own_from_world.expand(4, 4, 4))
    return EditedWorld(
        scene=scene,
        fitted=scene,
        lidar_map=LidarMap(street=points, actors={track.actor_id: points for track in tracks}),
        views=seen.views,
        parked=(),
        log=LogTimes(ego=ego),
    )


def done(world, other, *before, is_same_drive=True, world_from_other=WORLD_FROM_OTHER):
    joined_to = OtherRun(
        world=other, world_from_other=world_from_other, is_same_drive=is_same_drive
    )
    return edited(world, [*before, JOIN], {}, {JOIN: joined_to})


def actor(name, frames, *, left_m=0.0):
    """Drives to the left, at some frames of the log."""
    track = car_track(20)
    poses = track.world_from_box[frames].clone()
    poses[:, 1, 3] = left_m + 0.2 * torch.tensor(frames)
    return replace(
        track,
        actor_id=name,
        frame_indices=torch.tensor(frames),
        timestamps_ns=torch.tensor(frames) * FRAME_NS,
        world_from_box=poses,
        num_points=torch.ones(len(frames), dtype=torch.int64),
    )


def test_a_wall_goes_on_where_the_first_run_did_not_look_and_stands_once():
    ours, theirs = run(RED, 0.0), run(GREEN, 0.9, world_from_own=WORLD_FROM_OTHER)
    after = done(ours, theirs)
    means, is_green = after.scene.gaussians.means, after.scene.gaussians.base_rgb[:, 1] > 0.5
    torch.testing.assert_close(means[:, 0], torch.full((len(means),), 8.0), atol=1e-4, rtol=0)
    beside = means[:, 1] > 6.5  # our image ends at 5 m to the left, theirs begins at 2.3 m
    assert bool(is_green[beside & (means[:, 1] < 12)].all())
    assert not bool(is_green[means[:, 1] < 4].any())
    cells = (means / 0.3).round().unique(dim=0)
    assert len(cells) == len(means) == len(ours.scene.gaussians)  # no spot twice, none empty
    points = after.lidar_map.street
    is_green_point = points.rgb_u8[:, 1] > 128
    assert bool(is_green_point[(points.xyz_m[:, 1] > 6.5) & (points.xyz_m[:, 1] < 12)].all())
    assert not bool(is_green_point[points.xyz_m[:, 1] < 4].any())
    for view in ours.views:  # what was seen well stays as it was
        before, now = (
            scene.render(view.camera, view.timestamp_ns) for scene in (ours.fitted, after.scene)
        )
        assert float((before.rgb - now.rgb).abs()[:, 16:].max()) < 0.02
    whole = filled(after, ConditionConfig(num_references=1, num_sources=1), None)
    assert len(whole.confidence) == 0


def test_actors_go_on_and_those_of_the_same_time_come():
    ours = run(RED, 0.0, tracks=[actor("a", [1, 2])])
    tracks = [actor("a", [2, 3, 5]), actor("b", [0, 3], left_m=5), actor("late", [8, 9])]
    theirs = run(GREEN, 0.9, world_from_own=WORLD_FROM_OTHER, tracks=tracks, first_frame=2)
    after = done(ours, theirs)
    whole = {track.actor_id: track for track in after.moving}
    assert list(whole) == ["a", "b"]
    assert (whole["a"].timestamps_ns // FRAME_NS).tolist() == [1, 2, 3, 5]
    places_m = whole["a"].world_from_box[:, :3, 3]
    assert places_m[:, 1].tolist() == pytest.approx([0.2, 0.4, 0.6, 1.0], abs=1e-5)
    rgb = [after.model_of(whole[name]).gaussians.base_rgb[0, 1] for name in ("a", "b")]
    assert [round(float(green), 2) for green in rgb] == [0.1, 0.8]  # each as who saw it well
    assert after.came == ()  # recorded images show them: nothing is hidden
    without = done(ours, theirs, Remove(op="remove", actors=("a",)))
    assert [track.actor_id for track in without.moving] == ["b"]
    other_day = done(ours, theirs, is_same_drive=False)
    assert [track.actor_id for track in other_day.moving] == ["a"]
    assert (other_day.moving[0].timestamps_ns // FRAME_NS).tolist() == [1, 2]


def test_runs_that_cannot_be_joined_are_refused():
    ours = run(RED, 0.0)
    with pytest.raises(ConfigError, match="operation 1, join: that run has seen nothing much"):
        done(ours, ours, world_from_other=SAME)
    far = rigid_from_tangent(torch.tensor([0, 0, 0, 500.0, 0, 0]).double())
    with pytest.raises(ConfigError, match="do not overlap: no place was seen by both"):
        done(ours, run(GREEN, 0.9), world_from_other=far)
