"""Pieces of work beside each other make what they make one after the other."""

import os
import subprocess
import sys
import threading
import time

import numba
import numpy as np
import pytest
import torch

from lidarpainter_models.kernels import side_by_side as module
from lidarpainter_models.kernels.side_by_side import both, kernels_to_oneself, side_by_side

THREADS = 2
CPU, GPU = torch.device("cpu"), torch.device("cuda")


@numba.njit(parallel=True, nogil=True)
def summed(values):
    total = 0.0
    for i in numba.prange(len(values)):
        total += values[i]
    return total


@pytest.fixture(autouse=True)
def _two_threads():
    """At least two threads of kernels, and pools that are known to hold several Python threads."""
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one thread here: nothing runs beside anything")
    before, torch_before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(THREADS)
    summed(np.ones(4))
    if numba.threading_layer() not in module.REENTRANT:
        pytest.skip(f"numba's {numba.threading_layer()} holds one Python thread")
    yield
    numba.set_num_threads(before)
    torch.set_num_threads(torch_before)


def place_of(_item):
    time.sleep(0.05)
    return threading.get_ident(), numba.get_num_threads(), torch.get_num_threads()


def test_pieces_share_threads_before_any_kernel_ran_in_parallel():
    script = (
        "import threading, time\n"
        "from lidarpainter_models.kernels.side_by_side import side_by_side\n"
        "def place_of(_item):\n"
        "    time.sleep(0.05)\n"
        "    return threading.get_ident()\n"
        "print(len(set(side_by_side(place_of, range(7)))))\n"
    )
    threads = os.environ | {"NUMBA_NUM_THREADS": str(THREADS)}
    ran = subprocess.run(
        [sys.executable, "-c", script], env=threads, stdout=subprocess.PIPE, check=True
    )
    assert int(ran.stdout) == 1 + THREADS  # the first piece is made here


def test_pieces_come_in_order_and_take_their_time_together():
    def late_first(item):
        time.sleep(0.02 * (6 - item))
        return item * item

    assert list(side_by_side(late_first, range(6))) == [0, 1, 4, 9, 16, 25]


def test_the_first_piece_is_made_here_and_the_others_in_two_threads_of_one_each():
    torch_before = torch.get_num_threads()
    first, *others = side_by_side(place_of, range(7), CPU)
    here = threading.get_ident()
    assert first == (here, THREADS, torch_before)
    assert here not in {thread for thread, _, _ in others}
    assert len({thread for thread, _, _ in others}) == 2
    assert {counts[1:] for counts in others} == {(1, 1)}
    assert (numba.get_num_threads(), torch.get_num_threads()) == (THREADS, torch_before)


def test_work_of_a_gpu_or_of_one_thread_stays_here():
    assert {place[0] for place in side_by_side(place_of, range(3), GPU)} == {threading.get_ident()}
    numba.set_num_threads(1)
    assert {place[0] for place in side_by_side(place_of, range(3))} == {threading.get_ident()}


def test_where_pools_hold_one_thread_work_stays_here_and_kernels_are_alone(monkeypatch):
    monkeypatch.setattr(numba, "threading_layer", lambda: "workqueue")
    assert {place[0] for place in side_by_side(place_of, range(3))} == {threading.get_ident()}
    with kernels_to_oneself() as held:
        assert held
        assert module._ONE_AT_A_TIME.locked()


def test_a_piece_that_fails_ends_the_rest():
    begun = []

    def failing(item):
        begun.append(item)
        if item == 2:
            raise ValueError("the third")
        return item

    with pytest.raises(ValueError, match="the third"):
        list(side_by_side(failing, range(100)))
    assert len(begun) < 10
    assert list(side_by_side(failing, range(2))) == [0, 1]


def test_pieces_have_the_gradients_of_the_caller():
    def has_gradients(_item):
        return torch.is_grad_enabled()

    assert set(side_by_side(has_gradients, range(4))) == {True}
    with torch.no_grad():
        assert set(side_by_side(has_gradients, range(4))) == {False}


def test_both_run_at_once_with_half_of_the_threads_each():
    met = threading.Barrier(2, timeout=10)

    def meeting():
        met.wait()
        return place_of(None)

    (here, *first), (there, *second) = both(meeting, meeting, CPU)
    assert here == threading.get_ident() != there
    assert first == second == [1, 1]
    assert numba.get_num_threads() == THREADS
    assert both(lambda: 1, lambda: 2, GPU) == (1, 2)


def test_both_wait_for_each_other_when_one_fails():
    ended = []

    def slow():
        time.sleep(0.1)
        ended.append(True)

    def failing():
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        both(failing, slow, CPU)
    assert ended == [True]
    with pytest.raises(ValueError, match="no"):
        both(slow, failing, CPU)
    assert numba.get_num_threads() == THREADS
