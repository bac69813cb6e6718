"""Ingest many sequences: several at once, failures set aside, what is done not done again.

What was asked for and what came of it is noted below `<store>/ingested/` once a sequence is in the
store and the catalog. The same request for a scene that still has the content noted is answered
from there; a changed request, another version or a changed scene is read anew. Whether the source
files changed since is not looked at: `again` reads them anew. A sequence that was interrupted
leaves nothing behind and starts again at its first frame.
"""

import json
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lidarpainter_models
from catalog.errors import CatalogError
from catalog.store import open_store
from lidarpainter_models.errors import LidarPainterError
from lidarpainter_models.scenes.stored import stored_digest
from lidarpainter_models.storage.whole_files import write_whole
from tasks.ingest.ingest import ingest_sequence
from tasks.progress import listener

STAGE = "sequences"


@dataclass(frozen=True, slots=True)
class IngestRequest:
    """What is to be read from where, for every sequence alike."""

    store_path: Path
    dataset: str
    root: Path
    frames: slice | None = None
    cameras: tuple[str, ...] | None = None

    def key(self) -> dict[str, Any]:
        """What must be equal for an earlier answer to hold, JSON-able."""
        frames = self.frames
        return {
            "root": str(Path(self.root).resolve()),
            "frames": None if frames is None else [frames.start, frames.stop],
            "cameras": None if self.cameras is None else list(self.cameras),
            "software_version": lidarpainter_models.__version__,
        }


@dataclass
class Ingested:
    """Rows of the scenes, and one line for each sequence that failed."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    failures: list[dict[str, str]] = field(default_factory=list)


def ingest_sequences(
    request: IngestRequest,
    names: Sequence[str],
    *,
    jobs: int = 1,
    again: bool = False,
    on_failure: Callable[[str], None],
) -> Ingested:
    """Ingest sequences, `jobs` of them at once in processes of their own.

    Args:
        request: what to read.
        names: the sequences.
        jobs: with 1, everything happens in this process.
        again: read even what is done.
        on_failure: told the one-line error of each sequence that fails.

    Raises:
        LidarPainterError: the only sequence asked for failed.
        CatalogError: likewise.
    """
    done = Ingested()
    rows: dict[str, dict[str, Any]] = {}
    runs = _in_processes if jobs > 1 and len(names) > 1 else _in_turn
    for name, answer in runs(request, names, jobs, again):
        try:
            rows[name] = answer()
        except (LidarPainterError, CatalogError, BrokenProcessPool) as error:
            if len(names) == 1:
                raise
            text = str(error)
            if isinstance(error, BrokenProcessPool):
                text = f"{name}: the process that read it was ended from outside"
            done.failures.append({"sequence": name, "error": text})
            on_failure(text)
    done.rows = [rows[name] for name in names if name in rows]
    return done


def ingest_or_recall(request: IngestRequest, name: str, again: bool) -> dict[str, Any]:
    """The row of one sequence: noted when it was done before, else made now and noted."""
    note = request.store_path / "ingested" / request.dataset / f"{name}.json"
    if not again and (row := _noted(note, request)) is not None:
        return row
    row = ingest_sequence.fn(
        request.store_path, request.dataset, request.root, name, request.frames, request.cameras
    )
    write_whole(note, json.dumps({"request": request.key(), "row": row}).encode())
    return row


def _noted(note: Path, request: IngestRequest) -> dict[str, Any] | None:
    try:
        noted = json.loads(note.read_text("utf-8"))
        row = noted["row"]
        if noted["request"] != request.key():
            return None
        folder = open_store(request.store_path).scene_folder(row["scene_id"])
        return row if stored_digest(folder) == row["content_digest"] else None
    except (OSError, ValueError, KeyError, TypeError):
        return None  # no note, or one that cannot be read: the sequence is read anew


def _in_turn(
    request: IngestRequest, names: Sequence[str], _jobs: int, again: bool
) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    for name in names:
        yield name, lambda name=name: ingest_or_recall(request, name, again)  # type: ignore[misc]


def _in_processes(
    request: IngestRequest, names: Sequence[str], jobs: int, again: bool
) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    listener().started(STAGE)
    with ThreadPoolExecutor(jobs) as pool:
        futures: dict[Future[dict[str, Any]], str] = {
            pool.submit(_in_own_process, request, name, again): name for name in names
        }
        try:
            for count, future in enumerate(as_completed(futures), start=1):
                yield futures[future], future.result
                listener().advanced(STAGE, count, len(names), futures[future])
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _in_own_process(request: IngestRequest, name: str, again: bool) -> dict[str, Any]:
    """A process for one sequence alone: one that dies takes no other with it."""
    # a process inherits what its thread blocks: signals are for whoever has started it
    signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(ingest_or_recall, request, name, again).result()
