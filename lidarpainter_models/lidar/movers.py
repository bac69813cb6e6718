"""Who moves in a scene, from its LiDAR sweeps alone: tracks with boxes, as a data set would have.

What moves is found by free space (`moving_points`), put together over time (`mover_tracks`) and
boxed (`mover_boxes`); pieces of one thing are joined. World: z up; metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from lidarpainter_models.geometry.boxes import count_points_in_boxes
from lidarpainter_models.lidar.mover_boxes import Mover, boxed
from lidarpainter_models.lidar.mover_tracks import LONGEST_UNSEEN_S, tracked
from lidarpainter_models.lidar.moving_points import Clump, moving_clumps
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.tracks import ActorTrack, TrackPoses

BESIDE_M = 0.5
"""Pieces of one thing: the centre of one lies in the box of the other, grown by this."""
SAME_MPS = 2.0
"""Pieces of one thing move alike."""
AGAIN_M = 1.5
"""Who was hidden comes out again no farther from where it was to be."""
OVERLAP = 0.3
"""Share of frames in which a mover stands in a box that is there, from which on it has that box."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundActor:
    """One actor that was found."""

    track: ActorTrack
    score: float


def find_movers(scene: DrivingScene) -> list[FoundActor]:
    """The tracks of everything that moves, the longest ways first.

    Names are `found-001` and so on.
    """
    movers = [
        mover
        for track in tracked(moving_clumps(scene))
        if (mover := boxed(track.clumps)) is not None
    ]
    movers = _joined(movers)
    movers.sort(key=lambda mover: (-len(mover.clumps), mover.clumps[0].time_ns))
    counts = _held_points(scene, movers)
    return [
        FoundActor(
            track=_track(mover, f"found-{number:03d}", counts[number - 1]), score=mover.score
        )
        for number, mover in enumerate(movers, start=1)
    ]


def unboxed(found: Sequence[FoundActor], tracks: Sequence[ActorTrack]) -> list[FoundActor]:
    """Those of the actors found that no track has a box for."""
    return [actor for actor in found if box_of(actor.track, tracks) is None]


def box_of(track: ActorTrack, tracks: Sequence[ActorTrack]) -> ActorTrack | None:
    """The one of some tracks that stands where another does, in most of its frames."""
    shares = [_together(track, other) for other in tracks]
    best = int(np.argmax(shares)) if shares else 0
    return tracks[best] if shares and shares[best] >= OVERLAP else None


def _together(track: ActorTrack, other: ActorTrack) -> float:
    """Share of a track's times at which the other's centre is within half its own length."""
    reach_m = BESIDE_M + float(torch.maximum(track.size_m, other.size_m)[:2].max()) / 2
    poses, times_ns = TrackPoses.of([other]), track.timestamps_ns
    is_there = poses.present(times_ns[:, None])[:, 0]
    others = poses.at(torch.zeros_like(times_ns), times_ns)[:, :2, 3]
    is_near = (others - track.world_from_box[:, :2, 3]).norm(dim=1) < reach_m
    return float((is_there & is_near).double().mean())


def _joined(movers: list[Mover]) -> list[Mover]:
    """Movers of which none is a piece of another."""
    waiting, done = sorted(movers, key=lambda mover: -len(mover.clumps)), []
    while waiting:
        first = waiting.pop(0)
        for place, other in enumerate(waiting):
            both = _both(first, other) if _is_same(first, other) else None
            if both is not None:
                waiting[place] = both
                break
        else:
            done.append(first)
    return done


def _both(first: Mover, second: Mover) -> Mover | None:
    """One mover of two; None where that makes no sense."""
    by_frame: dict[int, Clump] = {}
    for clump in (*first.clumps, *second.clumps):
        known = by_frame.get(clump.frame_index)
        if known is not None:
            points_m = np.concatenate([known.points_m, clump.points_m])
            clump = replace(known, points_m=points_m)
        by_frame[clump.frame_index] = clump
    return boxed([by_frame[frame] for frame in sorted(by_frame)])


def _is_same(first: Mover, second: Mover) -> bool:
    """Whether two movers are pieces of one."""
    rows_of = {clump.frame_index: row for row, clump in enumerate(second.clumps)}
    shared = [
        (row, rows_of[clump.frame_index])
        for row, clump in enumerate(first.clumps)
        if clump.frame_index in rows_of
    ]
    if not shared:
        return _goes_on(first, second) or _goes_on(second, first)
    mine, other = map(list, zip(*shared, strict=True))
    apart_m = np.abs(second.places_m[other] - first.places_m[mine])
    reach_m = max(first.size_m[0], second.size_m[0]) / 2 + BESIDE_M
    unlike = np.linalg.norm(second.velocity_mps[other] - first.velocity_mps[mine], axis=1)
    is_near = np.linalg.norm(apart_m, axis=1) < reach_m
    return bool(is_near.mean() > 0.7 and np.median(unlike) < SAME_MPS)


def _goes_on(first: Mover, second: Mover) -> bool:
    """Whether the second comes out where the first was to be when it was hidden."""
    hidden_s = float(second.times_s[0] - first.times_s[-1])
    if not 0 < hidden_s < 2 * LONGEST_UNSEEN_S:
        return False
    way_m = (first.velocity_mps[-1] + second.velocity_mps[0]) / 2 * hidden_s
    off_m = second.places_m[0] - first.places_m[-1] - way_m
    unlike = float(np.linalg.norm(second.velocity_mps[0] - first.velocity_mps[-1]))
    return float(np.linalg.norm(off_m)) < AGAIN_M and unlike < 2 * SAME_MPS


def _held_points(scene: DrivingScene, movers: Sequence[Mover]) -> list[list[int]]:
    """How many points of its frame each box of each mover holds."""
    counts: list[list[int]] = [[0] * len(mover.clumps) for mover in movers]
    boxes: dict[int, list[tuple[int, int]]] = {}
    for number, mover in enumerate(movers):
        for row, clump in enumerate(mover.clumps):
            boxes.setdefault(clump.frame_index, []).append((number, row))
    for frame_index, here in boxes.items():
        poses = torch.stack([movers[number].world_from_box[row] for number, row in here])
        sizes_m = torch.from_numpy(np.stack([movers[number].size_m for number, _ in here]))
        held = count_points_in_boxes(scene.read_positions(frame_index), poses, sizes_m.float())
        for (number, row), count in zip(here, held.tolist(), strict=True):
            counts[number][row] = count
    return counts


def _track(mover: Mover, name: str, num_points: Sequence[int]) -> ActorTrack:
    return ActorTrack(
        actor_id=name,
        category=mover.category,
        is_moving=True,
        size_m=torch.from_numpy(mover.size_m).float(),
        frame_indices=torch.tensor([clump.frame_index for clump in mover.clumps]),
        timestamps_ns=torch.tensor([clump.time_ns for clump in mover.clumps]),
        world_from_box=mover.world_from_box,
        num_points=torch.tensor(num_points),
    )
