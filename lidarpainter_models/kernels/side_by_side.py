"""Independent pieces of work beside each other on a CPU, each in a thread of its own.

Work on one view is hundreds of small steps, and few of them have enough to do for many threads: two
threads paint one view no sooner than one does, but two views in little more than the time of one
(docs/decisions/views-side-by-side.md). Compiled kernels and torch let other Python threads run.
"""

import contextvars
import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, nullcontext
from threading import Lock
from typing import TypeVar

import numba
import torch

MOST_AT_ONCE = 4
"""Pieces that are in memory at a time; more threads than that are shared among them."""
REENTRANT = ("omp", "tbb")
"""Thread pools of numba that several Python threads may enter at once; `workqueue` is not one."""
_ONE_AT_A_TIME = Lock()
_BESIDE = ThreadPoolExecutor(1, "beside")
Item = TypeVar("Item")
Made = TypeVar("Made")
Other = TypeVar("Other")


def side_by_side(
    work: Callable[[Item], Made], items: Iterable[Item], device: torch.device | None = None
) -> Iterator[Made]:
    """What `work` makes of each item, in order; on a CPU several at once.

    It is what the same work would make one after the other, so pieces must not change what others
    read. Items are taken by the caller's thread, a few ahead. The first piece is made alone:
    it compiles what is not yet compiled. A piece that fails ends the rest.
    """
    rest = iter(items)
    yield from map(work, itertools.islice(rest, 1))
    threads = _shared_threads(device)
    at_once = min(threads, MOST_AT_ONCE)
    if at_once == 1:
        yield from map(work, rest)
        return
    before = torch.get_num_threads()
    begin = contextvars.copy_context
    alike = _as_here(work)
    waiting: deque[Future[Made]] = deque()
    with ThreadPoolExecutor(at_once, "piece", _with_threads, (threads // at_once,)) as pool:
        try:
            for item in rest:
                waiting.append(pool.submit(begin().run, alike, item))
                if len(waiting) > at_once:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for piece in waiting:
                piece.cancel()
            torch.set_num_threads(before)  # of threads that begin from now on


def both(
    first: Callable[[], Made], second: Callable[[], Other], device: torch.device
) -> tuple[Made, Other]:
    """What two different pieces make: at once on a CPU, each with half of the threads.

    Neither may change what the other reads, nor may they share a tensor that collects gradients:
    torch's lock of it and the interpreter's are taken in either order. On a GPU, and where there is
    one thread or a pool that holds no other, they are made one after the other.
    """
    threads = _shared_threads(device)
    if threads == 1:
        return first(), second()
    before = torch.get_num_threads()

    def with_half(_nothing: None) -> Other:
        _with_threads(threads // 2)
        return second()

    started = _BESIDE.submit(_as_here(with_half), None)
    _with_threads(threads - threads // 2)
    try:
        return first(), started.result()
    finally:
        wait([started])
        torch.set_num_threads(before)
        numba.set_num_threads(threads)


def kernels_to_oneself() -> AbstractContextManager[object]:
    """Keep other Python threads out of parallel kernels, where numba's pool cannot hold two."""
    return nullcontext() if _are_reentrant() else _ONE_AT_A_TIME


def _shared_threads(device: torch.device | None) -> int:
    """How many threads pieces on a device may share; 1 where they are made one by one."""
    if device is not None and device.type != "cpu":
        return 1
    threads = numba.get_num_threads()  # the pool starts, and is known from then on
    return threads if _are_reentrant() else 1


def _are_reentrant() -> bool:
    try:
        return numba.threading_layer() in REENTRANT
    except ValueError:  # no parallel kernel ran yet
        return False


def _with_threads(count: int) -> None:
    """Settle how many threads the kernels of this Python thread have."""
    torch.set_num_threads(count)
    numba.set_num_threads(count)


def _as_here(work: Callable[[Item], Made]) -> Callable[[Item], Made]:
    """The work with gradients if the calling thread has them, which others do not inherit."""
    has_gradients = torch.is_grad_enabled()

    def done(item: Item) -> Made:
        with torch.set_grad_enabled(has_gradients):
            return work(item)

    return done
