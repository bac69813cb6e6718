"""The tree of frames of a bag: where one stands in another at any time."""

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.timed_poses import poses_at
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.readers.bags.messages import BagTransform
from lidarpainter_models.readers.source_logs.drive_poses import NS_PER_S

MAX_GAP_NS = NS_PER_S
"""Between two poses of a moving frame; a car drives metres meanwhile."""
_DEEPEST = 64
"""Frames from one to the root; more are a circle."""
_Edge = tuple[str, Int64[np.ndarray, " poses"], Float[Tensor, "poses 4 4"]]


class FrameTree:
    """Frames by the one that each stands in; of one pose the frame does not move."""

    def __init__(self, transforms: Iterable[BagTransform], where: str) -> None:
        """Take in transforms in any order; of several at one time the last is kept.

        Raises:
            DataError: a frame stands in two others.
        """
        self._where = where
        found: dict[str, dict[int, Tensor]] = {}
        parents: dict[str, str] = {}
        for one in transforms:
            if parents.setdefault(one.child, one.parent) != one.parent:
                raise DataError(
                    f"{where}: frame {one.child!r:.60} stands in {parents[one.child]!r:.60} and in "
                    f"{one.parent!r:.60}, expected one of them"
                )
            found.setdefault(one.child, {})[one.time_ns] = one.parent_from_child
        self._edges: dict[str, _Edge] = {}
        for child, poses in found.items():
            times_ns = sorted(poses)
            stacked = torch.stack([poses[time_ns] for time_ns in times_ns])
            if bool((stacked == stacked[0]).all()):  # what is said again and again stands still
                times_ns, stacked = times_ns[:1], stacked[:1]
            self._edges[child] = (parents[child], np.array(times_ns, dtype=np.int64), stacked)

    @property
    def frames(self) -> tuple[str, ...]:
        """All frames that are named, sorted."""
        return tuple(sorted({*self._edges, *(parent for parent, _, _ in self._edges.values())}))

    def parent(self, frame: str) -> str | None:
        """The frame that one stands in; None for a root or an unknown one."""
        return self._edges[frame][0] if frame in self._edges else None

    def is_moving(self, frame: str) -> bool:
        """Whether a frame moves in the one that it stands in."""
        return frame in self._edges and len(self._edges[frame][1]) > 1

    def are_tied(self, first: str, second: str) -> bool:
        """Whether the tree says where one stands in the other."""
        return first == second or self._chain(first)[-1] == self._chain(second)[-1]

    def span_ns(self, target: str, source: str) -> tuple[int, int] | None:
        """First and last time at which all between two frames are known; None if nothing moves.

        Raises:
            DataError: the poses of a frame between them have a gap.
        """
        spans = []
        for frame in self._between(target, source):
            times_ns = self._edges[frame][1]
            if len(times_ns) == 1:
                continue
            widest = int(np.diff(times_ns).argmax())
            gap_ns = int(times_ns[widest + 1] - times_ns[widest])
            if gap_ns > MAX_GAP_NS:
                raise DataError(
                    f"{self._where}: no pose of frame {frame!r:.60} for {gap_ns / NS_PER_S:.2f} s "
                    f"after {times_ns[widest] / NS_PER_S:.3f} s, expected one every second"
                )
            spans.append((int(times_ns[0]), int(times_ns[-1])))
        if not spans:
            return None
        return max(first for first, _ in spans), min(last for _, last in spans)

    def times_ns(self, target: str, source: str) -> Int64[np.ndarray, " times"]:
        """All times at which a pose between two frames is stated, ascending."""
        known = [self._edges[frame][1] for frame in self._between(target, source)]
        moving = [times_ns for times_ns in known if len(times_ns) > 1]
        return np.unique(np.concatenate(moving)) if moving else np.zeros(1, dtype=np.int64)

    def poses(
        self, target: str, source: str, times_ns: Int64[np.ndarray, " times"]
    ) -> Float[Tensor, "times 4 4"]:
        """`target_from_source` at times, float64; beyond what is known the motion goes on.

        Raises:
            DataError: the tree does not tie the frames to each other.
        """
        first, second = self._chain(target), self._chain(source)
        if first[-1] != second[-1]:
            known = ", ".join(self.frames[:20]) or "none"
            raise DataError(
                f"{self._where}: nothing ties frame {source!r:.60} to {target!r:.60}, expected a "
                f"transform; frames: {known}"
            )
        return invert_rigid(self._to_root(first, times_ns)) @ self._to_root(second, times_ns)

    def _to_root(self, chain: list[str], times_ns: np.ndarray) -> Tensor:
        pose = torch.eye(4, dtype=torch.float64).expand(len(times_ns), 4, 4)
        for frame in chain[:-1]:
            _, known_ns, poses = self._edges[frame]
            pose = poses_at(poses, known_ns, times_ns) @ pose
        return pose

    def _between(self, target: str, source: str) -> list[str]:
        """Frames whose poses matter between two."""
        first, second = self._chain(target), self._chain(source)
        return sorted(set(first[:-1]) ^ set(second[:-1]))

    def _chain(self, frame: str) -> list[str]:
        """A frame, the one that it stands in, and so on to the root."""
        chain = [frame]
        while (parent := self.parent(chain[-1])) is not None:
            chain.append(parent)
            if len(chain) > _DEEPEST:
                raise DataError(f"{self._where}: frame {frame!r:.60} stands in itself")
        return chain
