"""Actors are found by what users call them."""

import pytest
import torch

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.scenes.actor_names import named_actor
from lidarpainter_models.scenes.tracks import ActorTrack

TIMES_NS = torch.arange(3) * 1_000_000_000


def path(x_m, y_m):
    tangents = torch.zeros(3, 6, dtype=torch.float64)
    tangents[:, 3] = x_m + 10.0 * torch.arange(3)
    tangents[:, 4] = y_m
    return rigid_from_tangent(tangents)


def actor(actor_id, x_m, y_m=0.0):
    return ActorTrack(
        actor_id=actor_id,
        category="car",
        is_moving=True,
        size_m=torch.tensor([4.0, 2.0, 1.5]),
        frame_indices=torch.arange(3),
        timestamps_ns=TIMES_NS,
        world_from_box=path(x_m, y_m),
        num_points=torch.ones(3).long(),
    )


EGO = DrivenPath(timestamps_ns=TIMES_NS, world_from_body=path(0.0, 0.0))
TRACKS = [actor("ab-1", 30), actor("ab-2", 12), actor("b", 8, 3.5), actor("ab", -9)]


@pytest.mark.parametrize(
    ("name", "expected"), [("ab-2", "ab-2"), ("ab", "ab"), ("b", "b"), ("nearest-ahead", "ab-2")]
)
def test_an_actor_is_named_by_id_beginning_or_place(name, expected):
    assert named_actor(TRACKS, name, EGO).actor_id == expected


@pytest.mark.parametrize(
    ("name", "complaint"),
    [("x", "no actor 'x', expected an id"), ("ab-", "not unique among 2: ab-1, ab-2"), ("", "no")],
)
def test_what_names_none_or_several_is_refused(name, complaint):
    with pytest.raises(SceneError, match=complaint):
        named_actor(TRACKS, name, EGO)


def test_nobody_may_be_ahead():
    for tracks in ([], TRACKS[2:]):
        with pytest.raises(SceneError, match="nobody is ahead within 2 m"):
            named_actor(tracks, "nearest-ahead", EGO)
