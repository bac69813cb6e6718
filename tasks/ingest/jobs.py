"""Ingest many sequences: several at once, failures set aside, what is done not done again.

What was asked for and what came of it is noted below `<store>/ingested/` once a sequence is in the
store and the catalog. The same request for a scene that still has the content noted is answered
from there; another version or a changed scene is read anew. Other cameras, frames or another root
than the scene that is there was read with, fewer ones too, are refused: runs stand on it, and
`again` alone replaces it. Whether the source files changed since is not looked at. A sequence that
was interrupted leaves nothing behind and starts again at its first frame.
"""

import hashlib
import json
import multiprocessing
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lidarpainter_models
from catalog.errors import CatalogError
from catalog.leases import ConditionalObjects
from catalog.store import Store, open_store, split_scene_id
from lidarpainter_models.errors import ConfigError, LidarPainterError
from tasks.ingest.bucket_roots import normal_root
from tasks.ingest.ingest import STAGE as ONE_SEQUENCE
from tasks.ingest.ingest import ingest_sequence
from tasks.ingest.sequences import find_scene_id
from tasks.opened import open_scene
from tasks.progress import listener

STAGE = "sequences"
WAIT = "wait"
"""In place of a stage: another process brings the scene in."""


@dataclass(frozen=True, slots=True)
class IngestRequest:
    """What is to be read from where, for every sequence alike."""

    store_path: Path
    dataset: str
    root: Path
    frames: slice | None = None
    cameras: tuple[str, ...] | None = None
    rig: Path | None = None
    """Of a bag: which topic is which sensor; as proposed if None."""

    def key(self) -> dict[str, Any]:
        """What must be equal for an earlier answer to hold, JSON-able."""
        frames = self.frames
        return {
            "root": normal_root(self.root),
            "frames": None if frames is None else [frames.start, frames.stop],
            "cameras": None if self.cameras is None else list(self.cameras),
            "rig": None if self.rig is None else hashlib.sha256(self.rig.read_bytes()).hexdigest(),
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

    A single job reads in this process; `again` reads even what is done; `on_failure` is told the
    one-line error of each sequence that fails.

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
    """The row of one sequence: noted when it was done before, else made now and noted.

    Raises:
        UnknownRecordError: the name would lead out of the store.
        ConfigError: the scene is in the store, read with another choice than this.
    """
    scene_id = f"{request.dataset}/{name}"
    split_scene_id(scene_id)
    if again:
        return _read(request, name)
    row = _known(request, name)
    if row is None:
        with sole_reader(open_store(request.store_path), scene_id):
            row = _known(request, name)
            if row is None:
                return _read(request, name)
    listener().started(ONE_SEQUENCE)
    listener().finished(ONE_SEQUENCE, 0.0, is_new=False)
    return row


@contextmanager
def sole_reader(store: Store, scene_id: str) -> Iterator[None]:
    """Bring a scene in alone, of all that share the store; look first whether another just has."""
    began, waited = time.perf_counter(), False

    def wait(holder: str) -> None:
        nonlocal waited
        waited = True
        listener().started(WAIT)
        listener().waiting(WAIT, holder)

    store.make()
    with store.alone(f"ingest-{scene_id.replace('/', '-')}", on_wait=wait):
        if waited:
            listener().finished(WAIT, time.perf_counter() - began, is_new=True)
        yield


def _read(request: IngestRequest, name: str) -> dict[str, Any]:
    """Read a sequence and note it; returns its row."""
    row = ingest_sequence.fn(
        *(request.store_path, request.dataset, request.root, name),
        *(request.frames, request.cameras, request.rig),
    )
    notes, note = _notes(request), json.dumps({"request": request.key(), "row": row}).encode()
    noted = notes.read(f"{name}.json")
    notes.write(f"{name}.json", note, replacing=noted and noted[1])
    return row


def _notes(request: IngestRequest) -> ConditionalObjects:
    return open_store(request.store_path).objects(f"ingested/{request.dataset}")


def _known(request: IngestRequest, name: str) -> dict[str, Any] | None:
    """The row of the scene if it is there as asked for; None where it has to be read."""
    found = _notes(request).read(f"{name}.json")
    asked, row, earlier = request.key(), {}, {}
    try:
        noted = json.loads(found[0] if found else b"")
        row, earlier = dict(noted["row"]), dict(noted["request"])
        scene_id, digest = row["scene_id"], row["content_digest"]
    except (ValueError, KeyError, TypeError):  # no note, or one that cannot be read
        scene_id, digest = find_scene_id(request.dataset, request.root, name), None
    try:
        stored = open_scene(open_store(request.store_path), scene_id).manifest
    except (LidarPainterError, CatalogError):
        return None
    if stored["content_digest"] != digest:
        earlier = {}  # nothing is noted of the scene that is there, but it has its cameras
    there = {**asked, "rig": None, **earlier, "cameras": sorted(stored["camera_names"])}
    if asked["cameras"] is None and earlier.get("cameras") is None:
        there["cameras"] = None
    differing = [what for what, say in WORDS.items() if say(there[what]) != say(asked[what])]
    if differing:
        raise ConfigError(_refusal(scene_id, differing, there, asked))
    is_same = earlier.get("software_version") == asked["software_version"]
    return row if is_same else None


def _frames(chosen: Sequence[int | None] | None) -> str:
    start, stop = chosen or (None, None)
    return "all frames" if not start and stop is None else f"frames {start or 0}:{stop or ''}"


WORDS: dict[str, Callable[[Any], str]] = {
    "cameras": lambda names: f"cameras {', '.join(sorted(set(names)))}" if names else "all cameras",
    "frames": _frames,
    "root": lambda root: f"root {root}",
    "rig": lambda digest: f"the map {digest[:8]}" if digest else "no map",
}
"""How a choice is said, part by part; choices that are said alike are the same."""


def _refusal(
    scene_id: str, differing: Sequence[str], there: Mapping[str, Any], asked: Mapping[str, Any]
) -> str:
    before, now = ("; ".join(WORDS[one](each[one]) for one in differing) for each in (there, asked))
    hint = ""
    if "cameras" in differing and set(asked["cameras"] or ("all",)) < set(there["cameras"]):
        hint = " (`reconstruct --train-cameras` takes some of its cameras)"
    return (
        f"scene {scene_id} is in the store with {before}, asked for: {now}; it was kept, "
        f"--again replaces it{hint}"
    )


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
