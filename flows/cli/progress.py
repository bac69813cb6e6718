"""Progress on stderr: bars on a terminal, plain lines with the same content elsewhere."""

import logging
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TextColumn
from rich.text import Text

from flows.cli.output import clear_status, loudness
from tasks.progress import ProgressListener, listening

if TYPE_CHECKING:
    from flows.time_prediction import Clock
    from lidarpainter_models.kernels.compile_clock import CompileClock

LINE_EVERY_S = 30.0
"""How often a stage says how far it is where no bar can be drawn."""


MOST_SHOWN = 0.99
"""Part of a stage that is shown at most until it is over: what it made is still to be written."""


def how_far(clock: "Clock", stage: str, done: float, total: float | None, note: str = "") -> str:
    """Return what is known of a stage under way, such as `stage 4 of 11, 41 %, 0:31 gone, ...`.

    What is left goes unsaid where a stage, or the last of a run, takes longer than was thought, and
    a share where the `total` is not known: None or 0. The `note` is a figure worth showing.
    """
    share = f"{100 * min(done / total, MOST_SHOWN):.0f} %" if total else ""
    if total and total > 1:
        share = f"{done:.0f}/{total:.0f} {share}"
    times = _times(clock.elapsed(stage), clock.left(stage))
    if stage in clock.expected:
        times += f"; {_of_run(clock, stage)}"
    return ", ".join(part for part in (clock.place(stage), share, times, note) if part)


def _of_run(clock: "Clock", stage: str) -> str:
    return f"run {_times(clock.elapsed(), clock.run_left(stage))}"


def _times(gone: float, left: float | None) -> str:
    from flows.time_prediction import as_clock

    return f"{as_clock(gone)} gone" + (f", {as_clock(left)} left" if left else "")


class HowFar(ProgressColumn):
    """The figures of a stage, as they are whenever the bar is drawn."""

    def __init__(self, clock: "Clock") -> None:
        super().__init__()
        self._clock = clock

    def render(self, task: Task) -> Text:
        """Return the text beside a bar."""
        if said := task.fields["said"]:
            return Text(said)
        done, total = task.fields["done"], task.total
        return Text(how_far(self._clock, task.description, done, total, task.fields["note"]))


class Bars(ProgressListener):
    """One bar per stage on a terminal."""

    def __init__(self, progress: Progress, clock: "Clock") -> None:
        self._progress, self._clock = progress, clock
        self._tasks: dict[str, TaskID] = {}

    def started(self, stage: str) -> None:
        """Draw an empty bar."""
        self._clock.started(stage)
        self._tasks[stage] = self._progress.add_task(stage, total=None, note="", said="", done=0.0)

    def advanced(self, stage: str, done: float, total: float, note: str) -> None:
        """Fill the bar, but for its end."""
        share = done / max(total, 1e-9)
        self._clock.advanced(stage, share)
        self._progress.update(
            self._tasks[stage],
            completed=min(share, MOST_SHOWN) * total,
            total=total,
            note=note,
            said="",
            done=done,
        )

    def waiting(self, stage: str, process_id: str) -> None:
        """Say whom the stage waits for."""
        said = f"waiting for process {process_id}, which computes the same"
        self._progress.update(self._tasks[stage], said=said)

    def finished(self, stage: str, seconds: float, *, is_new: bool) -> None:
        """Complete the bar."""
        self._clock.finished(stage, is_new=is_new)
        said = f"{seconds:.1f} s" if is_new else "was there"
        self._progress.update(self._tasks[stage], completed=1, total=1, said=said)


class Lines(ProgressListener):
    """A line per event, and one every half minute within a stage."""

    def __init__(self, clock: "Clock") -> None:
        self._clock = clock
        self._said_s: dict[str, float] = {}

    def started(self, stage: str) -> None:
        """Start the clock of the stage; say which of a run's it is."""
        self._clock.started(stage)
        self._said_s[stage] = time.monotonic()
        if place := self._clock.place(stage):
            sys.stderr.write(f"{stage}: {place} begins; {_of_run(self._clock, stage)}\n")

    def advanced(self, stage: str, done: float, total: float, note: str) -> None:
        """Say how far the stage is, not too often."""
        self._clock.advanced(stage, done / max(total, 1e-9))
        if time.monotonic() - self._said_s[stage] >= LINE_EVERY_S:
            self._said_s[stage] = time.monotonic()
            sys.stderr.write(f"{stage}: {how_far(self._clock, stage, done, total, note)}\n")

    def waiting(self, stage: str, process_id: str) -> None:
        """Say whom the stage waits for."""
        sys.stderr.write(f"{stage}: waiting for process {process_id}, which computes the same\n")

    def finished(self, stage: str, seconds: float, *, is_new: bool) -> None:
        """Say what the stage took."""
        self._clock.finished(stage, is_new=is_new)
        sys.stderr.write(f"{stage}: {f'{seconds:.1f} s' if is_new else 'was there'}\n")


class SaidLines(logging.Handler):
    """Log lines above the bars, or between the lines."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write one; stderr is looked up each time, as bars take its place while they are drawn."""
        sys.stderr.write(f"{record.getMessage()}\n")


class _Compiling:
    """Seconds of compiling kernels since it was first asked, as the first stage began."""

    def __init__(self) -> None:
        self._clock: CompileClock | None = None

    def __call__(self) -> float:
        if self._clock is None:
            # brings numba along, which a mistyped command must not wait for
            from lidarpainter_models.kernels.compile_clock import CompileClock

            self._clock = CompileClock()
            self._clock.start()
        return self._clock.cpu_seconds

    def stop(self) -> None:
        if self._clock is not None:
            self._clock.stop()


@contextmanager
def shown_progress(
    expected: Mapping[str, float] | None = None, *, is_told_by_past: bool = True
) -> Iterator[ProgressListener]:
    """Show the progress of every stage that runs inside the block, as loud as was chosen.

    What is expected, and whether past runs tell of it: see `flows.time_prediction`.
    """
    from flows.time_prediction import Clock

    clear_status()
    if loudness() == "quiet":
        yield ProgressListener()  # nobody listens
        return
    log, lines = logging.getLogger("lidarpainter"), SaidLines()
    if loudness() == "verbose":
        log.setLevel(logging.INFO)
        log.addHandler(lines)
    compiling = _Compiling()
    told = bool(expected) and is_told_by_past
    clock = Clock(expected=expected or {}, is_told_by_past=told, compiled=compiling)
    try:
        with _listener(clock) as listener, listening(listener):
            yield listener
    finally:
        compiling.stop()
        log.removeHandler(lines)


@contextmanager
def _listener(clock: "Clock") -> Iterator[ProgressListener]:
    console = Console(stderr=True)
    if not console.is_terminal:
        yield Lines(clock)
        return
    columns = [TextColumn("{task.description:<12}"), BarColumn(bar_width=20), HowFar(clock)]
    with Progress(*columns, console=console) as progress:
        yield Bars(progress, clock)
