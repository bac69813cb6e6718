"""One frame as a reader hands it to the writer, and frames read ahead of the one being written.

Unpacking, hashing and sorting release the interpreter, so threads prepare the next frames while
the last one is written. They are handed on in order: what is stored does not depend on the
number of threads, and never more than `num_threads` + 1 frames are in memory.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from jaxtyping import Float, UInt8
from torch import Tensor

from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, SweepPoints
from lidarpainter_models.scenes.writer import SceneWriter

NUM_READING_THREADS = 1
"""Beside the threads that check and write: on two cores a second one only waits for the others."""

Content = TypeVar("Content")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceImage:
    """A picture, and the file it came from."""

    record: ImageRecord
    jpeg: bytes
    source: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceSweep:
    """A turn of a LiDAR, and the file it came from."""

    lidar_name: str
    points: SweepPoints
    timestamp_ns: int
    """Middle of the sweep."""
    world_from_lidar: Float[Tensor, "4 4"]
    semantics: UInt8[Tensor, " points"] | None
    source: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameContent:
    """Everything of one frame."""

    frame_index: int
    timestamp_ns: int
    world_from_ego: Float[Tensor, "4 4"]
    images: list[SourceImage]
    sweeps: list[SourceSweep]
    boxes: list[BoxRecord]

    def write(self, writer: SceneWriter) -> None:
        """Add the frame to a scene."""
        writer.add_frame(
            self.frame_index, timestamp_ns=self.timestamp_ns, world_from_ego=self.world_from_ego
        )
        for image in self.images:
            writer.add_image(image.record, image.jpeg, source=image.source)
        for sweep in self.sweeps:
            writer.add_sweep(
                sweep.lidar_name,
                sweep.points,
                timestamp_ns=sweep.timestamp_ns,
                world_from_lidar=sweep.world_from_lidar,
                semantics=sweep.semantics,
                source=sweep.source,
            )
        writer.add_boxes(self.boxes)


@contextmanager
def read_ahead(
    read: Callable[[int], Content], frame_indices: Sequence[int], *, num_threads: int
) -> Iterator[Iterator[Content]]:
    """What `read` gives for each frame, in order; an error is raised when its frame is due.

    With zero threads each frame is read when it is asked for. Leaving the block ends the threads.
    """
    if num_threads == 0:
        yield map(read, frame_indices)
        return
    pool = ThreadPoolExecutor(num_threads, thread_name_prefix="frame")
    try:
        yield _in_order(pool, read, frame_indices, num_threads)
    finally:
        pool.shutdown(cancel_futures=True)


def _in_order(
    pool: ThreadPoolExecutor,
    read: Callable[[int], Content],
    frame_indices: Sequence[int],
    num_ahead: int,
) -> Iterator[Content]:
    waiting: deque[Future[Content]] = deque()
    for frame_index in frame_indices:
        waiting.append(pool.submit(read, frame_index))
        if len(waiting) > num_ahead:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()
