"""Damage one file of a log after the other and judge what a reader makes of each.

    verdict = judge(lambda: ingest(...), store=..., sandbox=..., named=("sample.json", "scene-1"))
    outcomes = fuzz(ingest, damage, range(10_000), sandbox=..., named=...)

A reader may refuse a damaged log with one line that names the place, or write a scene that opens
and can be checked, within 10 s and 2 GiB; `judge` raises `AssertionError` on everything else.
`pytest --log-file=FILE --log-file-level=INFO` shows how far a long run is.
"""

import functools
import logging
import os
import resource
import shutil
import signal
import threading
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np

from lidarpainter_models.checks.doctor import check_scene
from lidarpainter_models.errors import LidarPainterError
from lidarpainter_models.scenes.driving_scene import DrivingScene
from tasks.measuring import measured

MAX_SECONDS = 10.0
MAX_MEMORY_BYTES = 2 << 30
REPORT_EVERY = 250
_ticks = count(1)
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Verdict:
    """How one ingest of a damaged log ended."""

    error: str | None
    """The one line it was refused with."""
    failed_checks: tuple[str, ...] = ()
    """What the doctor found wrong with the scene that was written."""

    @property
    def outcome(self):
        if self.error is not None:
            return "refused"
        return "found by the doctor" if self.failed_checks else "accepted"


def fuzz(ingest, damage, seeds, *, sandbox, named):
    """Damage one file per seed, judge, put the file back; counts how the ingests ended.

    Args:
        ingest: reads the log into the folder it is given, and gives the path of the scene.
        damage: takes a generator; gives the path of a file of the log and its `Damage`.
        seeds: one for each case.
        sandbox: a folder that holds the log and in which `store` is made.
        named: texts one of which an error must contain.
    """
    outcomes: Counter[str] = Counter()
    store = Path(sandbox, "store")
    for seed in seeds:
        file, damaged = damage(np.random.default_rng(seed))
        sound = file.read_bytes()
        replace(file, damaged.content)
        try:
            verdict = judge(
                functools.partial(ingest, store), store=store, sandbox=sandbox, named=named
            )
        except BaseException as error:
            error.add_note(f"seed {seed}: {file}: {damaged.description}")
            raise
        finally:
            replace(file, sound)
            shutil.rmtree(store, ignore_errors=True)
        outcomes[verdict.outcome] += 1
        if verdict.failed_checks:
            _log.info("seed %d: %s: %s: %s", seed, file, damaged.description, verdict.failed_checks)
        if outcomes.total() % REPORT_EVERY == 0:
            _log.info("%d cases: %s", outcomes.total(), dict(outcomes))
    return outcomes


def replace(file, content):
    """Write a file with a time of its own, so that no cache takes it for the one before."""
    file.write_bytes(content)
    os.utime(file, ns=(next(_ticks), next(_ticks)))


def judge(ingest, *, store, sandbox, named):
    """Run one ingest and tell how it ended.

    Args:
        ingest: reads the damaged log into `store` and gives the path of the scene.
        store: the folder it may write to, empty before, somewhere below `sandbox`.
        sandbox: a folder of which nothing else may change.
        named: texts one of which an error must contain, so that it names a file or a place.
    """
    before = _contents(sandbox, store)
    try:
        with _time_limit(MAX_SECONDS), _memory_limit(MAX_MEMORY_BYTES):
            path = ingest()
    except LidarPainterError as error:
        message = str(error)
        assert "\n" not in message, f"more than one line: {message!r}"
        assert any(text in message for text in named), f"no place is named: {message!r}"
        left = [path for path in Path(store).rglob("*") if path.is_file()]
        assert left == [], f"a refused log left {left}"
        verdict = Verdict(error=message)
    else:
        assert Path(path).resolve().is_relative_to(Path(store).resolve()), path
        with _time_limit(MAX_SECONDS), _memory_limit(MAX_MEMORY_BYTES):
            verdict = Verdict(error=None, failed_checks=_failed_checks(path))
    assert _contents(sandbox, store) == before, "something outside the store was written"
    return verdict


def _failed_checks(path):
    """What the doctor finds; asked once about equal scenes, whose stored content is read anew."""
    scene = DrivingScene.open(path)
    scene.verify_content()
    if scene.content_digest not in _KNOWN_SCENES:
        checks = check_scene(_remembering(scene))
        failed = [f"{check.name}: {check.detail}" for check in checks if check.verdict == "fail"]
        _KNOWN_SCENES[scene.content_digest] = tuple(failed)
    return _KNOWN_SCENES[scene.content_digest]


_KNOWN_SCENES: dict[str, tuple[str, ...]] = {}


def _remembering(scene):
    """A scene that reads each sweep once, however many checks ask for it."""
    read, kept = scene.read_sweep, {}

    def read_once(sweep):
        if sweep.offset not in kept:
            kept[sweep.offset] = read(sweep)
        return kept[sweep.offset]

    scene.read_sweep = read_once
    return scene


def _contents(sandbox, store):
    """Name, size and time of all files of a folder but those of the store."""
    found = {}
    for folder, folders, files in os.walk(sandbox):
        folders[:] = [name for name in folders if Path(folder, name) != Path(store)]
        for name in files:
            stat = os.lstat(Path(folder, name))
            found[str(Path(folder, name))] = (stat.st_size, stat.st_mtime_ns)
    return found


@contextmanager
def _memory_limit(num_bytes):
    """An error once the process asks for so much more; the resident set is judged afterwards.

    Both count from where the process stands, the set from its highest yet where no peak can be
    reset: tests before may have left gigabytes with it.
    """
    with measured() as before:
        pass
    earlier = resource.getrlimit(resource.RLIMIT_DATA)
    most_bytes = _process_bytes("VmData") + 2 * num_bytes
    resource.setrlimit(resource.RLIMIT_DATA, (most_bytes, earlier[1]))
    try:
        with measured() as cost:
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, earlier)
    taken_bytes = cost.peak_memory_bytes - before.peak_memory_bytes
    assert taken_bytes < num_bytes, f"{taken_bytes} bytes of memory"


def _process_bytes(name):
    """A size from this process's status, such as the resident set (proc(5))."""
    status = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in status if line.startswith(f"{name}:"))


@contextmanager
def _time_limit(seconds):
    """An AssertionError in the main thread once so much CPU time is spent; elsewhere no limit.

    A process that waits on a busy machine spends none; one that waits forever is stopped as well,
    after twelve times as long.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def over(number, _frame):
        kind = "of CPU time" if number == signal.SIGPROF else "of waiting"
        raise AssertionError(f"not done after {factors[number] * seconds} s {kind}")

    timers = ((signal.SIGPROF, signal.ITIMER_PROF, 1), (signal.SIGALRM, signal.ITIMER_REAL, 12))
    factors = {number: factor for number, _, factor in timers}
    earlier = [signal.signal(number, over) for number, _, _ in timers]
    for _, timer, factor in timers:
        signal.setitimer(timer, factor * seconds)
    try:
        yield
    finally:
        for (number, timer, _), handler in zip(timers, earlier, strict=True):
            signal.setitimer(timer, 0)
            signal.signal(number, handler)
