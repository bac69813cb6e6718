"""What numba takes to compile kernels: paid once a machine, and told apart from their work."""

import time

from numba.core.event import Event, Listener, register, unregister

COMPILING = "numba:compile"
"""The event of what is compiled, not of what is found in the cache."""


class CompileClock(Listener):
    """CPU seconds of compiling between start and stop, of the one thread that works."""

    def __init__(self) -> None:
        self.cpu_seconds = 0.0
        self._depth = 0
        self._began = 0.0

    def start(self) -> None:
        """Listen from here on."""
        register(COMPILING, self)

    def stop(self) -> None:
        """Listen no more."""
        unregister(COMPILING, self)

    def on_start(self, event: Event) -> None:  # noqa: ARG002 - as numba calls it
        """Something is compiled, perhaps for something else that is."""
        if self._depth == 0:
            self._began = time.thread_time()
        self._depth += 1

    def on_end(self, event: Event) -> None:  # noqa: ARG002
        """It is over."""
        self._depth -= 1
        if self._depth == 0:
            self.cpu_seconds += time.thread_time() - self._began
