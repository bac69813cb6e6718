"""Close loops of a drive that comes back to where it was.

What odometry is off by grows with the way. Where the car comes near a place that it left long ago,
its sweep is laid onto the planes of then; a pose graph (Choi et al., 2015, by Open3D) shares what
that says among all poses between. A drive that never comes back stays as it is.
World: x forward, y left, z up; metres.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch

from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.lidar.sweep_registration import SweptFrame, laid, planes_of

LEAST_WAY_M, NEAR_M = 60.0, 12.0
"""Between two passings of a place; how near the second comes to it."""
TRIED_APART_M = 5.0
"""Between two tries."""
AROUND = 2
"""Frames before and after that make the planes of a place."""
STEPS_M = ((4.0, 1.0), (2.0, 0.3), (1.0, 0.1), (0.4, 0.04))
LEAST_LAID = 0.5
"""Share of points that must lie on planes where a loop is believed."""
STEP_INFORMATION = np.diag([1e6] * 3 + [1e4] * 3)
"""Of odometry from frame to frame: a milliradian and a centimetre."""
LOOP_INFORMATION = np.diag([2.5e5] * 3 + [2.5e3] * 3)
"""Of a loop: twice as uncertain."""


def with_loops_closed(path: DrivenPath, frames: Sequence[SweptFrame]) -> DrivenPath:
    """The path with its loops closed; itself where it has none.

    Args:
        path: poses of the frames as odometry found them.
        frames: what was seen from each, in the same world.
    """
    loops = _loops(path, frames)
    if not loops:
        return path
    import open3d

    registration = open3d.pipelines.registration
    poses = path.world_from_body
    graph = registration.PoseGraph()
    for pose in poses:
        graph.nodes.append(registration.PoseGraphNode(pose.numpy().copy()))
    edges = [
        (number, number + 1, (invert_rigid(after) @ before).numpy(), STEP_INFORMATION)
        for number, (before, after) in enumerate(pairwise(poses))
    ]
    edges += [
        (first, second, np.linalg.inv(first_from_second), LOOP_INFORMATION)
        for first, second, first_from_second in loops
    ]
    for edge in edges:
        graph.edges.append(registration.PoseGraphEdge(*edge, False))
    registration.global_optimization(
        graph,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        registration.GlobalOptimizationOption(reference_node=0),
    )
    closed = torch.from_numpy(np.stack([np.asarray(node.pose) for node in graph.nodes]))
    return DrivenPath(timestamps_ns=path.timestamps_ns, world_from_body=closed)


def _loops(path: DrivenPath, frames: Sequence[SweptFrame]) -> list[tuple[int, int, np.ndarray]]:
    """Pairs of frames of one place long apart, with where the second stands in the first."""
    travelled_m = path.travelled_m.numpy()
    places_m = path.world_from_body[:, :3, 3].numpy()
    found, tried_m = [], -np.inf
    for second in range(len(frames)):
        earlier = int(np.searchsorted(travelled_m, travelled_m[second] - LEAST_WAY_M, "right"))
        if not earlier or travelled_m[second] < tried_m + TRIED_APART_M:
            continue
        away_m = np.linalg.norm(places_m[:earlier] - places_m[second], axis=1)
        first = int(away_m.argmin())
        if away_m[first] > NEAR_M:
            continue
        tried_m = travelled_m[second]
        onto = planes_of(frames[max(0, first - AROUND) : first + AROUND + 1])
        seen_m = frames[second].points_m[frames[second].compared]
        motion, share = laid(seen_m, onto, places_m[second], STEPS_M)
        if motion is not None and share >= LEAST_LAID:
            moved = motion @ path.world_from_body[second].numpy()
            found.append(
                (first, second, np.linalg.inv(path.world_from_body[first].numpy()) @ moved)
            )
    return found
