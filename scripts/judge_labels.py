"""Hold what is found from sweeps alone against what a log says: where the car drove, and who moves.

    python scripts/judge_labels.py STORE pandaset/002 synthetic/street-0401 ...

Poses and boxes of the scenes are the truth. An actor counts that goes faster than 1 m/s and has in
three frames at least 30 points within 40 m; it is found if one track's centre is within 0.5 m of
its, seen from above, in 80 % of these frames. A mover is false where no moving box of the log is.
"""

import sys
import time
from pathlib import Path

import numpy as np
import torch

from catalog.store import open_store
from lidarpainter_models.lidar.movers import FoundActor, box_of, find_movers
from lidarpainter_models.lidar.odometry import drive_of, path_difference
from lidarpainter_models.scenes.driving_scene import DrivingScene, driven_road
from lidarpainter_models.scenes.tracks import ActorTrack, TrackPoses
from tasks.opened import open_scene

LEAST_MPS, NEAR_M, LEAST_POINTS, LEAST_FRAMES = 1.0, 40.0, 30, 3
CENTRE_M, LEAST_SHARE = 0.5, 0.8


def counted_rows(scene: DrivingScene, track: ActorTrack) -> list[int]:
    """The frames of an actor in which it has to be found; none where it goes too slowly."""
    seconds = (track.timestamps_ns - track.timestamps_ns[0]).double() * 1e-9
    places = track.world_from_box[:, :2, 3]
    if len(track.timestamps_ns) < LEAST_FRAMES:
        return []
    way_m = float((places[-1] - places[0]).norm())
    if not track.is_moving or way_m / float(seconds[-1]) <= LEAST_MPS:
        return []
    rows = []
    for row, frame_index in enumerate(track.frame_indices.tolist()):
        ego = scene.world_from_ego[scene.frame_position(frame_index), :2, 3]
        is_near = float((places[row] - ego).norm()) <= NEAR_M
        if is_near and int(track.num_points[row]) >= LEAST_POINTS:
            rows.append(row)
    return rows if len(rows) >= LEAST_FRAMES else []


def offsets_m(track: ActorTrack, rows: list[int], found: ActorTrack) -> np.ndarray:
    """How far a found track's centre is from an actor's in some of its frames; inf without one."""
    frames = found.frame_indices.tolist()
    own = [frames.index(frame) if frame in frames else -1 for frame in track.frame_indices[rows]]
    times_ns = found.timestamps_ns[own]
    truth = TrackPoses.of([track]).at(torch.zeros_like(times_ns), times_ns)[:, :2, 3]
    apart_m = (found.world_from_box[own, :2, 3] - truth).norm(dim=1).numpy()
    return np.where(np.array(own) < 0, np.inf, apart_m)


def judge_movers(scene: DrivingScene, found: list[FoundActor]) -> dict[str, object]:
    """Figures of the tracks found."""
    wanted = {
        track.actor_id: (track, rows)
        for track in scene.tracks
        if (rows := counted_rows(scene, track))
    }
    right = []
    for actor_id, (track, rows) in wanted.items():
        apart = [(offsets_m(track, rows, one.track), one.track) for one in found]
        near = [float((offsets <= CENTRE_M).mean()) for offsets, _ in apart]
        best = int(np.argmax(near)) if near else -1
        is_found = bool(near) and near[best] >= LEAST_SHARE
        right.append(is_found)
        if not is_found:
            told = "nobody"
            if near:
                offsets, other = apart[best]
                finite = offsets[np.isfinite(offsets)]
                middle = f"{np.median(finite):.2f} m" if len(finite) else "never"
                size = [round(v, 1) for v in other.size_m.tolist()]
                told = f"{other.actor_id} {near[best]:.0%} near, {middle}, {size}"
            size = [round(v, 1) for v in track.size_m.tolist()]
            sys.stdout.write(
                f"  missed {actor_id[:8]} {track.category} {size}, {len(rows)} frames, "
                f"{int(track.num_points[rows].median())} points: {told}\n"
            )
    moving = [track for track in scene.tracks if track.is_moving]
    false = [one for one in found if box_of(one.track, moving) is None]
    for one in false:
        there = box_of(one.track, scene.tracks)
        first = one.track.world_from_box[0, :2, 3].tolist()
        way_m = float(
            (one.track.world_from_box[-1, :2, 3] - one.track.world_from_box[0, :2, 3]).norm()
        )
        sys.stdout.write(
            f"  false {one.track.actor_id} {one.track.category} at {first[0]:.0f}, {first[1]:.0f}: "
            f"{len(one.track.frame_indices)} frames, {way_m:.1f} m, score {one.score}, "
            f"{int(one.track.num_points.median())} points, "
            f"in the place of {there.category if there else 'nothing'}\n"
        )
    return {
        "movers": len(wanted),
        "found": sum(right),
        "tracks": len(found),
        "false": len(false),
        "mean_score_of_false": round(float(np.mean([one.score for one in false] or [0.0])), 2),
    }


def main(folder: str, *scene_ids: str) -> None:
    """Judge some scenes of a store."""
    torch.set_num_threads(1)
    for scene_id in scene_ids:
        scene = open_scene(open_store(Path(folder)), scene_id)
        began = time.process_time()
        difference = path_difference(drive_of(scene), driven_road(scene))
        between = time.process_time()
        found = find_movers(scene)
        took_s = time.process_time() - between
        figures = judge_movers(scene, found)
        sys.stdout.write(f"{scene_id}: {figures}, {took_s:.0f} CPU s; ")
        sys.stdout.write(f"poses {difference}, {between - began:.0f} CPU s\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
