"""What a person changes about boxes is replayed as it was done, or refused in a line."""

import json
from unittest.mock import Mock

import pytest
import torch

from lidarpainter_models.editing.track_edits import (
    Delete,
    Merge,
    Rename,
    Split,
    TrackEdits,
    edited_scores,
    edited_tracks,
)
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.tracks import ActorTrack

FRAME_NS = 100_000_000


def track(name, frames, points, *, length_m=4.0, speed_mps=10.0):
    """Somebody who drives along x."""
    frames = torch.tensor(frames)
    poses = torch.eye(4, dtype=torch.float64).repeat(len(frames), 1, 1)
    poses[:, 0, 3] = 0.1 * speed_mps * frames
    return ActorTrack(
        actor_id=name,
        category="car",
        is_moving=speed_mps > 0,
        size_m=torch.tensor([length_m, 1.8, 1.5]),
        frame_indices=frames,
        timestamps_ns=frames * FRAME_NS,
        world_from_box=poses,
        num_points=torch.tensor(points),
    )


def edited_after(tracks, edits):
    return edited_tracks(tracks, edits, "edits.json")


SCENE = Mock(DrivingScene, dataset="d", sequence="s", content_digest="abc")
HEAD = {"scene": "d/s", "digest": "abc"}


@pytest.fixture
def tracks():
    return [
        track("a", [0, 1, 2, 3], [50, 50, 10, 10]),
        track("b", [2, 3, 4, 5], [90, 5, 90, 90], length_m=5.0),
        track("c", [0, 1], [3, 3], speed_mps=0.0),
    ]


def test_pieces_become_one_with_the_fullest_box_of_each_frame(tracks):
    one, other = edited_after(tracks, [Merge(actors=("a", "b"))])
    assert (one.actor_id, other.actor_id) == ("a", "c")
    assert one.frame_indices.tolist() == [0, 1, 2, 3, 4, 5]
    assert one.timestamps_ns.tolist() == [FRAME_NS * frame for frame in range(6)]
    assert one.num_points.tolist() == [50, 50, 90, 10, 90, 90]
    assert one.size_m[0] == 5.0  # of the piece that most points tell of
    assert torch.equal(one.world_from_box[:, 0, 3], torch.arange(6).double())


def test_from_a_frame_on_somebody_is_another_one(tracks):
    first, *_, rest = edited_after(tracks, [Split(actor="a", frame=3, name="a-2")])
    assert first.frame_indices.tolist() == [0, 1, 2]
    assert (rest.actor_id, rest.frame_indices.tolist()) == ("a-2", [3])
    assert not rest.is_moving  # of one box nothing tells that it moves


def test_names_of_later_edits_are_those_that_earlier_ones_gave(tracks):
    edits = [
        Rename(actor="a", name="truck-1", category="truck"),
        Merge(actors=("truck-1", "b")),
        Delete(actors=("c",)),
    ]
    (one,) = edited_after(tracks, edits)
    assert (one.actor_id, one.category, len(one.frame_indices)) == ("truck-1", "truck", 6)
    assert [each.actor_id for each in tracks] == ["a", "b", "c"]


def test_edits_come_back_from_their_file(tmp_path):
    file, begun = tmp_path / "edits.json", TrackEdits.begun(SCENE)
    file.write_bytes(begun.file)
    assert TrackEdits.read(file, SCENE) == begun
    edits = [Split(actor="b", frame=4, name="b-2"), Rename(actor="b", category="bus")]
    file.write_bytes(begun.with_edits(edits).file)
    assert list(TrackEdits.read(file, SCENE).edits) == edits
    assert len(file.read_text().splitlines()) == 4  # an edit a line
    assert json.loads(file.read_text()) == begun.with_edits(edits).told


def test_scores_go_with_the_names():
    scores = {"a": 0.9, "b": 0.6, "c": 0.3, "d": 0.5}
    edits = [
        Merge(actors=("b", "a")),
        Split(actor="c", frame=3, name="c-2"),
        Delete(actors=("d",)),
        Rename(actor="c", name="d"),
    ]
    assert edited_scores(scores, edits) == {"b": 0.9, "d": 0.3, "c-2": 0.3}


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        (Delete(actors=("nobody",)), "delete: there is no actor 'nobody' among 3"),
        (Rename(actor="a", name="b"), "rename: an actor is called 'b' already"),
        (Split(actor="a", frame=0, name="d"), "split: .*expected one of 1 to 3"),
    ],
)
def test_what_makes_no_sense_is_refused_with_the_number_of_the_edit(tracks, edit, expected):
    with pytest.raises(ConfigError, match=rf"edits\.json operation 2, {expected}"):
        edited_after(tracks, [Rename(actor="c", category="sign"), edit])


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ({"op": "merge", "actors": ["a"]}, "actors"),
        ({"op": "merge", "actors": ["a", "a"]}, "expected every actor once"),
        ({"op": "split", "actor": "a", "frame": -1, "name": "b"}, "frame"),
        ({"op": "split", "actor": "a", "frame": 10**30, "name": "b"}, "frame"),
        ({"op": "rename", "actor": "a", "name": "../b"}, "cannot be used"),
        ({"op": "rename", "actor": "a", "category": "two\nlines"}, "printable"),
        ({"op": "rename", "actor": "a"}, "expected name or category"),
        ({"op": "paint", "actor": "a"}, "op"),
    ],
)
def test_files_with_other_things_are_refused_in_one_line(tmp_path, content, expected):
    file = tmp_path / "edits.json"
    file.write_text(json.dumps({**HEAD, "edits": [content]}))
    with pytest.raises(ConfigError) as refused:
        TrackEdits.read(file, SCENE)
    assert "operation 1" in str(refused.value)
    assert expected in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[", "no file of edits"),
        ("[]", "should be"),
        (json.dumps({"scene": "d/s"}), "digest"),
        (json.dumps({**HEAD, "digest": "def"}), "expected those of d/s (content abc)"),
        (json.dumps({**HEAD, "edits": [{"op": "delete", "actors": ["a"]}] * 10_001}), "edits"),
    ],
)
def test_another_file_or_one_of_another_scene_is_refused(tmp_path, text, expected):
    file = tmp_path / "edits.json"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"edits\.json") as refused:
        TrackEdits.read(file, SCENE)
    assert expected in str(refused.value)


def test_a_file_that_is_not_there_or_too_large_is_refused(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="no file of edits"):
        TrackEdits.read(tmp_path / "edits.json", SCENE)
    monkeypatch.setattr("lidarpainter_models.editing.track_edits.MOST_BYTES", 10)
    (tmp_path / "edits.json").write_bytes(TrackEdits.begun(SCENE).file)
    with pytest.raises(ConfigError, match="expected at most"):
        TrackEdits.read(tmp_path / "edits.json", SCENE)
