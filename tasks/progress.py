"""How far a stage is, told to whoever listens.

Tasks report here; the command line listens and draws. Nobody has to listen: a flow on a work pool
reports into silence. The listener belongs to the running context, so two flows in one process do
not hear each other.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Protocol


class Watch(Protocol):
    """Shows running fits to somebody; see `lidarpainter_models.viewing.watching`."""

    def is_due(self) -> bool:
        """Whether what is shown is so old that it should be replaced."""

    def show(self, scene: Any, views: Any) -> None:  # noqa: ANN401 - what a fit is no part of here
        """Show a scene (`GaussianScene`), seen from the first of its training views."""


class ProgressListener:
    """Hears about stages, and says nothing unless a method is written anew.

    A stage is named by the word used in `seconds` of the results.
    """

    watch: Watch | None = None
    """What shows running fits, where somebody watches."""

    def started(self, stage: str) -> None:
        """A stage begins."""

    def advanced(self, stage: str, done: float, total: float, note: str) -> None:
        """A part of a stage is done; `note` is a short figure worth showing, or empty."""

    def waiting(self, stage: str, process_id: str) -> None:
        """Another process computes the same; this one waits for its result."""

    def finished(self, stage: str, seconds: float, *, is_new: bool) -> None:
        """A stage is over; `is_new` tells whether it was computed now."""


_SILENCE = ProgressListener()
_listener: ContextVar[ProgressListener | None] = ContextVar("progress_listener", default=None)


def listener() -> ProgressListener:
    """Who listens in this context."""
    return _listener.get() or _SILENCE


_subject: ContextVar[Mapping[str, str] | None] = ContextVar("progress_subject", default=None)


def subject() -> Mapping[str, str]:
    """Return what is worked on in this context: `scene` and `run`, as far as they are known."""
    return _subject.get() or {}


@contextmanager
def working_on(**facts: str) -> Iterator[None]:
    """Say of everything inside the block what it is about."""
    token = _subject.set({**subject(), **facts})
    try:
        yield
    finally:
        _subject.reset(token)


Progress = Callable[..., None]
"""Told how much is done of how much, and perhaps a short figure worth showing."""


def progress_of(stage: str) -> Progress:
    """Return what a stage calls with how much is done of how much, and perhaps a short figure."""

    def advanced(done: float, total: float, note: str = "") -> None:
        listener().advanced(stage, done, total, note)

    return advanced


@contextmanager
def listening(to: ProgressListener) -> Iterator[None]:
    """Let a listener hear everything that runs inside the block."""
    token = _listener.set(to)
    try:
        yield
    finally:
        _listener.reset(token)
