from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.scenes.tracks import (
    MOST_TIMES,
    ActorTrack,
    TrackPoses,
    does_move,
    remembered,
    tracks_from_boxes,
)


def track(actor_id, times_ns):
    generator = torch.Generator().manual_seed(len(actor_id))
    count = len(times_ns)
    return ActorTrack(
        actor_id=actor_id,
        category="car",
        is_moving=True,
        size_m=torch.tensor([4.0, 2.0, 1.5]),
        frame_indices=torch.arange(count),
        timestamps_ns=torch.tensor(times_ns),
        world_from_box=rigid_from_tangent(torch.randn(count, 6, generator=generator).double()),
        num_points=torch.ones(count, dtype=torch.int64),
    )


TRACKS = (
    track("long", [0, 100_000_000, 230_000_000, 300_000_000]),
    track("one box", [150_000_000]),
    track("late", [200_000_000, 290_000_000]),
)


def test_all_tracks_at_once_stand_where_each_alone_does():
    poses = TrackPoses.of(TRACKS)
    for time_ns in (-70_000_000, 0, 1, 150_000_000, 230_000_000, 260_000_000, 900_000_000):
        alone = torch.stack([one.pose_at(time_ns) for one in TRACKS])
        assert torch.allclose(poses.all_at(time_ns), alone, atol=1e-12), time_ns
        there = [one.is_present(time_ns) for one in TRACKS]
        assert poses.present(time_ns).tolist() == there, time_ns


SECONDS = 1_000_000_000


def test_an_actor_that_was_out_of_sight_for_seconds_is_away_meanwhile():
    frames = torch.tensor([0, 1, 2, 40, 41])
    gone = replace(track("gone", (frames * SECONDS // 10).tolist()), frame_indices=frames)
    asked = [-0.06, 0.0, 0.2, 0.24, 0.26, 2.0, 3.94, 3.96, 4.1, 4.16]
    expected = [False, True, True, True, False, False, False, True, True, False]
    times_ns = (torch.tensor(asked, dtype=torch.float64) * SECONDS).round().long()
    poses = TrackPoses.of([*TRACKS, gone])
    assert poses.present(times_ns[:, None])[:, -1].tolist() == expected
    assert [bool(poses.present(int(at))[-1]) for at in times_ns] == expected
    assert [gone.is_present(int(at)) for at in times_ns] == expected


@pytest.mark.parametrize(
    ("frames", "step_s"),
    [
        ([0, 1, 9, 10], 0.1),  # hidden for a moment
        ([0, 1, 2, 3], 2.0),  # labelled in frames that lie so far apart
        ([0, 0, 0, 0], 5.0),  # an edit's: of no frame
    ],
)
def test_an_actor_stays_between_boxes_that_lie_as_close_as_can_be(frames, step_s):
    times_ns = [round(step_s * SECONDS * max(at, place)) for place, at in enumerate(frames)]
    there = replace(track("there", times_ns), frame_indices=torch.tensor(frames))
    middles = [(before + after) // 2 for before, after in pairwise(times_ns)]
    assert [there.is_present(at) for at in middles] == [True] * 3


def test_of_two_boxes_of_one_time_the_later_given_is_kept():
    boxes = {"actor_id": ["a"] * 3, "category": ["car"] * 3, "is_moving": [True] * 3}
    boxes |= {name: [1.0] * 3 for name in ("length_m", "width_m", "height_m")}
    boxes |= {"timestamp_ns": [5, 9, 5], "frame_index": [0, 1, 2], "num_points": [1, 2, 3]}
    (found,) = tracks_from_boxes(boxes, torch.eye(4, dtype=torch.float64).repeat(3, 1, 1))
    assert found.timestamps_ns.tolist() == [5, 9]
    assert found.num_points.tolist() == [3, 2]


def test_each_query_has_its_own_track_and_time():
    rows, times_ns = torch.tensor([2, 0, 0]), torch.tensor([250_000_000, 50_000_000, -5])
    alone = [
        TRACKS[row].pose_at(at) for row, at in zip(rows.tolist(), times_ns.tolist(), strict=True)
    ]
    assert torch.allclose(TrackPoses.of(TRACKS).at(rows, times_ns), torch.stack(alone), atol=1e-12)


def test_presence_is_asked_for_many_times_at_once():
    times_ns = torch.tensor([[0], [180_000_000]])
    there = TrackPoses.of(TRACKS).present(times_ns, 0)
    assert there.tolist() == [[True, False, False], [True, False, False]]


def test_without_tracks_there_are_no_poses():
    poses = TrackPoses.of(())
    assert len(poses) == 0
    assert poses.all_at(5).shape == (0, 4, 4)
    assert poses.present(5).shape == (0,)


@pytest.mark.parametrize(
    ("along_m", "moves"),
    [
        ([0.0], False),
        ([5.0, 5.3, 4.8, 5.9], False),  # a parked car's boxes jitter
        ([0.0, 0.5, 1.0], True),
        ([0.0, 2.0, 0.0], True),  # there and back
    ],
)
def test_who_gets_a_metre_from_its_first_box_moves(along_m, moves):
    centres_m = torch.zeros(len(along_m), 3, dtype=torch.float64)
    centres_m[:, 1] = torch.tensor(along_m, dtype=torch.float64)
    assert does_move(centres_m) is moves


def test_what_is_remembered_of_times_does_not_grow_for_ever():
    known = {}
    for time_ns in range(3 * MOST_TIMES):
        assert remembered(known, time_ns, lambda time_ns=time_ns: time_ns + 1) == time_ns + 1
        assert len(known) <= MOST_TIMES
    assert remembered(known, 3 * MOST_TIMES - 1, lambda: None) == 3 * MOST_TIMES
