"""One worker that draws what is asked for, in order: a bounded queue of work with a time limit.

Kernels take all threads of the machine for one image, and the images of a batch are drawn side by
side; two requests at once would only get into each other's way. What is asked for while the same is
being made is answered by it.
"""

from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeoutError
from threading import Lock
from typing import Any, TypeVar

from lidarpainter_models.serving.refusals import RequestError

Made = TypeVar("Made")


class RenderQueue:
    """Work that waits, and the work that is being done."""

    def __init__(self, most_waiting: int, limit_s: float) -> None:
        """Allow so many pieces at a time, each with so many seconds from being asked for."""
        self.most_waiting, self.limit_s = most_waiting, limit_s
        self._worker = ThreadPoolExecutor(1, "renderer")
        self._pending: dict[Hashable, Future[Any]] = {}
        self._lock = Lock()
        self._is_closed = False

    def answer(self, key: Hashable, work: Callable[[], Made], limit_s: float | None = None) -> Made:
        """What a piece of work gives, or the same piece that is under way.

        Args:
            key: equal for work that gives the same.
            work: is done by the worker.
            limit_s: of the one who asks, where it is shorter than the queue's.

        Raises:
            RequestError: RESOURCE_EXHAUSTED: too much waits; DEADLINE_EXCEEDED; UNAVAILABLE: the
                server ends.
        """
        future = self._submitted(key, work)
        limit_s = self.limit_s if limit_s is None else min(limit_s, self.limit_s)
        try:
            return future.result(limit_s)
        except FutureTimeoutError:
            if not future.done():
                raise RequestError(
                    "DEADLINE_EXCEEDED", f"not answered within {limit_s:g} s"
                ) from None
            raise

    def _submitted(self, key: Hashable, work: Callable[[], Made]) -> Future[Made]:
        with self._lock:
            if self._is_closed:
                raise RequestError("UNAVAILABLE", "the server ends")
            if key in self._pending:
                return self._pending[key]
            if len(self._pending) >= self.most_waiting:
                raise RequestError(
                    "RESOURCE_EXHAUSTED",
                    f"{len(self._pending)} requests wait: expected to be asked again later",
                )
            future = self._worker.submit(work)
            self._pending[key] = future
        future.add_done_callback(lambda _done: self._forget(key))
        return future

    def _forget(self, key: Hashable) -> None:
        with self._lock:
            self._pending.pop(key, None)

    def close(self) -> None:
        """Refuse what waits and what comes."""
        with self._lock:
            self._is_closed = True
        self._worker.shutdown(wait=False, cancel_futures=True)
