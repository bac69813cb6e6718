"""Actors by what users call them: an id, the beginning of one, or `nearest-ahead`."""

from collections.abc import Sequence

import torch

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.scenes.tracks import ActorTrack, TrackPoses

NEAREST_AHEAD = "nearest-ahead"
LANE_HALF_WIDTH_M = 2.0
"""Whose middle is farther aside drives or stands in another lane."""
MOST_NAMED = 5


def named_actor(tracks: Sequence[ActorTrack], name: str, ego: DrivenPath) -> ActorTrack:
    """The actor of a name.

    `nearest-ahead` is the actor nearest before the ego, in its lane, when first there is one.

    Raises:
        SceneError: none or several actors are called so, or nobody is ahead.
    """
    if name == NEAREST_AHEAD:
        return _nearest_ahead(tracks, ego)
    exact = [track for track in tracks if track.actor_id == name]
    found = exact or [track for track in tracks if name and track.actor_id.startswith(name)]
    if len(found) == 1:
        return found[0]
    if found:
        ids = ", ".join(track.actor_id for track in found[:MOST_NAMED])
        raise SceneError(f"actor {name!r} is not unique among {len(found)}: {ids}")
    ids = ", ".join(track.actor_id for track in tracks[:MOST_NAMED])
    more = ", ..." if len(tracks) > MOST_NAMED else ""
    raise SceneError(
        f"no actor {name!r}, expected an id, the beginning of one, or {NEAREST_AHEAD}; there "
        f"{'is' if len(tracks) == 1 else 'are'} {len(tracks)}: {ids or 'none'}{more}"
    )


def path_of_track(track: ActorTrack) -> DrivenPath:
    """The way an actor went."""
    return DrivenPath(
        timestamps_ns=track.timestamps_ns, world_from_body=track.world_from_box.double()
    )


def _nearest_ahead(tracks: Sequence[ActorTrack], ego: DrivenPath) -> ActorTrack:
    if tracks:
        poses, times_ns = TrackPoses.of(tracks), ego.timestamps_ns
        rows = torch.arange(len(tracks)).repeat_interleave(len(ego))
        centres = poses.at(rows, times_ns.repeat(len(tracks)))[:, :3, 3]
        away = centres.unflatten(0, (len(tracks), len(ego))) - ego.world_from_body[:, :3, 3]
        ahead_m, aside_m, _ = torch.einsum(
            "tij,ati->atj", ego.world_from_body[:, :3, :3], away
        ).unbind(-1)
        present = poses.present(times_ns[:, None]).T
        in_lane = present & (ahead_m > 0) & (aside_m.abs() < LANE_HALF_WIDTH_M)
        moments = in_lane.any(dim=0).nonzero()[:, 0]
        if len(moments):
            distance_m = torch.where(in_lane[:, moments[0]], ahead_m[:, moments[0]], torch.inf)
            return tracks[int(distance_m.argmin())]
    raise SceneError(
        f"{NEAREST_AHEAD}: nobody is ahead within {LANE_HALF_WIDTH_M:g} m to the side at any time"
    )
