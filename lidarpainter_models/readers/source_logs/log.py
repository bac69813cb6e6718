"""What a reader makes of a log, and the one loop that writes it into the store.

Unpacking, hashing and sorting release the interpreter, so a thread prepares the next frame while
the last one is written. Frames are read in order by that one thread: a log may be a stream, what
is stored does not depend on it, and never more than two frames are in memory: on two cores more
only wait for the threads that check and write.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

from lidarpainter_models.errors import DataError, LidarPainterError, WriteError
from lidarpainter_models.readers.source_logs.drive_checks import DriveChecks
from lidarpainter_models.scenes.frame_content import FrameContent
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter

Progress = Callable[[int, int], None]
"""Told frames done and frames in all."""
Content = TypeVar("Content")


@runtime_checkable
class SourceLog(Protocol):
    """One sequence of a dataset; what the first frame needs is read when it is opened."""

    place: str
    """File or folder, to name in errors."""
    dataset: str
    sequence: str
    header: SceneHeader
    frame_indices: list[int]
    """The frames asked for, ascending."""
    is_drive: bool
    """Whether it must be what a car recorded (drive_checks.py); any rig may be in a scene."""

    def read_frame(self, frame_index: int) -> FrameContent:
        """Everything of one frame; frames are asked for in the order of `frame_indices`."""
        ...

    def provenance(self) -> dict[str, object]:
        """What was read, with digests; asked for after the last frame."""
        ...


def write_log(log: SourceLog, store: Path, *, progress: Progress | None = None) -> Path:
    """Write a log into the store as a canonical scene; gives the scene's path.

    Raises:
        DataError: something in the log is missing, damaged or makes no sense.
        WriteError: the store cannot be written.
    """
    num_frames = len(log.frame_indices)
    checks = DriveChecks(num_frames) if log.is_drive else None
    with (
        naming(log.place),
        SceneWriter(store, log.dataset, log.sequence, log.header) as writer,
        read_ahead(log.read_frame, log.frame_indices) as contents,
    ):
        for done, content in enumerate(contents, start=1):
            with naming(content.place, within=log.place):
                if checks is not None:
                    checks.require_frame(content)
                content.write(writer)
            if progress is not None:
                progress(done, num_frames)
        if checks is not None:
            checks.require_all_cameras()
            checks.require_points_in_boxes()
        writer.set_provenance(log.provenance())
    return writer.path


@contextmanager
def naming(place: str, *, within: str | None = None) -> Iterator[None]:
    """Put a place in front of errors without one: the writer knows only the scene.

    Errors that name the place, or one within the larger place `within`, stay as they are.
    """
    try:
        yield
    except WriteError:
        raise
    except LidarPainterError as error:
        if (within or place) in str(error):
            raise
        raise DataError(f"{place}: {error}") from None


@contextmanager
def read_ahead(
    read: Callable[[int], Content], frame_indices: Sequence[int]
) -> Iterator[Iterator[Content]]:
    """What `read` gives for each frame, in order; an error is raised when its frame is due.

    Leaving the block ends the thread.
    """
    pool = ThreadPoolExecutor(1, thread_name_prefix="frame")

    def in_order() -> Iterator[Content]:
        ahead: Future[Content] | None = None
        for frame_index in frame_indices:
            due, ahead = ahead, pool.submit(read, frame_index)
            if due is not None:
                yield due.result()
        if ahead is not None:
            yield ahead.result()

    try:
        yield in_order()
    finally:
        pool.shutdown(cancel_futures=True)


def chosen_frames(num_frames: int, frames: slice | None, where: object) -> list[int]:
    """Positions of the frames asked for; all of them if None.

    Raises:
        DataError: none is left.
    """
    chosen = list(range(num_frames))[frames or slice(None)]
    if not chosen:
        raise DataError(f"{where}: the frames asked for select none of its {num_frames} frames")
    return chosen


def chosen_cameras(
    wanted: tuple[str, ...] | None, known: Iterable[str], where: object
) -> tuple[str, ...]:
    """Names of the cameras asked for, each once; all that are known if None.

    Raises:
        DataError: there is no such camera.
    """
    names = tuple(known)
    for name in wanted or ():
        if name not in names:
            raise DataError(f"{where}: no camera {name!r}, expected some of {', '.join(names)}")
    return names if wanted is None else tuple(dict.fromkeys(wanted))
