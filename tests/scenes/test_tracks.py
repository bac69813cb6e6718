import pytest
import torch

from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.scenes.tracks import ActorTrack, TrackPoses, does_move


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
