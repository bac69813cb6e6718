"""What a worker does as JSON lines: one for each event, with scene, run and stage where known.

{"time": "...", "fleet": "...", "worker": "...", "event": "stage-ended",
 "scene": "pandaset/002", "run": "...", "stage": "fit", "seconds": 61.2, "is_new": true}
"""

import json
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Literal

from catalog.leases import Holder
from tasks.progress import ProgressListener, subject

Event = Literal["said", "stage-began", "stage-waits", "stage-ended"]


class EventLog(ProgressListener):
    """Takes what a worker says, and listens to its stages."""

    def __init__(self, fleet: str, write: Callable[[str], object]) -> None:
        self._write = write
        self._always = {"fleet": fleet, "worker": Holder.current().name}

    def __call__(self, text: str) -> None:
        """Enter what the worker says, in words."""
        self._enter("said", text=" ".join(text.split()))

    def started(self, stage: str) -> None:
        """Enter that a stage begins."""
        self._enter("stage-began", stage=stage)

    def advanced(self, stage: str, done: float, total: float, note: str) -> None:
        """Enter nothing: a stage says this many times a second."""

    def waiting(self, stage: str, process_id: str) -> None:
        """Enter that another process makes the same."""
        self._enter("stage-waits", stage=stage, process=process_id)

    def finished(self, stage: str, seconds: float, *, is_new: bool) -> None:
        """Enter that a stage is over, and what it took when it was computed."""
        self._enter("stage-ended", stage=stage, seconds=round(seconds, 3), is_new=is_new)

    def _enter(self, event: Event, **facts: str | float | bool) -> None:
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = {"time": now, **self._always, "event": event, **subject(), **facts}
        self._write(json.dumps(line, ensure_ascii=False) + "\n")
