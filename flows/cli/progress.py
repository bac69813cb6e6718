"""Progress bars on stderr; plain lines where stderr is no terminal."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from flows.cli.output import clear_status
from tasks.progress import ProgressListener, listening

LINE_EVERY_S = 30.0
"""How often a stage says how far it is where no bar can be drawn."""


class Bars:
    """One bar per stage on a terminal."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._tasks: dict[str, TaskID] = {}

    def started(self, stage: str) -> None:
        """Draw an empty bar."""
        self._tasks[stage] = self._progress.add_task(stage, total=None, note="")

    def advanced(self, stage: str, done: float, total: float, note: str) -> None:
        """Fill the bar."""
        self._progress.update(self._tasks[stage], completed=done, total=total, note=note)

    def waiting(self, stage: str, process_id: str) -> None:
        """Say whom the stage waits for."""
        note = f"waiting for process {process_id}, which computes the same"
        self._progress.update(self._tasks[stage], note=note)

    def finished(self, stage: str, seconds: float, *, is_new: bool) -> None:
        """Complete the bar."""
        note = f"{seconds:.1f} s" if is_new else "was there"
        self._progress.update(self._tasks[stage], completed=1, total=1, note=note)


class Lines:
    """A line per event, and one every half minute within a stage."""

    def __init__(self) -> None:
        self._said_s: dict[str, float] = {}

    def started(self, stage: str) -> None:
        """Start the clock of the stage."""
        self._said_s[stage] = time.monotonic()

    def advanced(self, stage: str, done: float, total: float, note: str) -> None:
        """Say how far the stage is, not too often."""
        if time.monotonic() - self._said_s[stage] >= LINE_EVERY_S:
            self._said_s[stage] = time.monotonic()
            sys.stderr.write(f"{stage}: {100 * done / max(total, 1e-9):.0f} % {note}\n")

    def waiting(self, stage: str, process_id: str) -> None:
        """Say whom the stage waits for."""
        sys.stderr.write(f"{stage}: waiting for process {process_id}, which computes the same\n")

    def finished(self, stage: str, seconds: float, *, is_new: bool) -> None:
        """Say what the stage took."""
        sys.stderr.write(f"{stage}: {f'{seconds:.1f} s' if is_new else 'was there'}\n")


@contextmanager
def shown_progress() -> Iterator[ProgressListener]:
    """Draw the progress of every stage that runs inside the block."""
    clear_status()
    console = Console(stderr=True)
    if not console.is_terminal:
        lines = Lines()
        with listening(lines):
            yield lines
        return
    columns = [
        TextColumn("{task.description:<12}"),
        BarColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    ]
    with Progress(*columns, console=console) as progress:
        bars = Bars(progress)
        with listening(bars):
            yield bars
