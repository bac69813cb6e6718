"""What this machine can do at most: multiply-adds and memory traffic of one core."""

import time

import numba
import numpy as np

CHAIN = 8
LANES = 256
"""As many independent chains as hide the latency of a multiply-add and still fit in registers."""
COPIED_BYTES = 1 << 27


@numba.njit(fastmath={"contract"}, error_model="numpy")
def _multiply_add(rounds, factor, summand, lanes):
    for _ in range(rounds):
        for k in range(np.uint64(LANES)):
            x = lanes[k]
            x = x * factor + summand
            x = x * factor + summand
            x = x * factor + summand
            x = x * factor + summand
            x = x * factor + summand
            x = x * factor + summand
            x = x * factor + summand
            x = x * factor + summand
            lanes[k] = x


@numba.njit(parallel=True, fastmath={"contract"}, error_model="numpy")
def _multiply_add_in_halves(rounds, factor, summand, lanes):
    for half in numba.prange(2):
        _multiply_add(rounds, factor, summand, lanes[half])


def multiply_adds():
    """Work in two halves that share nothing and stay in registers: what two threads can halve."""
    lanes = np.zeros((2, LANES), np.float32)
    _multiply_add_in_halves(20_000, np.float32(0.999), np.float32(1e-3), lanes)


def best_cpu_s(work, repeats, clock=time.process_time):
    """Least CPU time of the process (all threads) over some runs: what others take does not count.

    By `time.perf_counter` wall time, which means something only while the cores are free. A first
    run compiles and is not counted.
    """
    work()
    best = float("inf")
    for _ in range(repeats):
        before = clock()
        work()
        best = min(best, clock() - before)
    return best


def fma_peak_flops(repeats=20, rounds=20_000):
    """Float32 operations per second of one core, a multiply-add being two."""
    lanes = np.zeros(LANES, np.float32)
    factor, summand = np.float32(0.999), np.float32(1e-3)
    seconds = best_cpu_s(lambda: _multiply_add(rounds, factor, summand, lanes), repeats)
    return 2.0 * CHAIN * LANES * rounds / seconds


def copy_bandwidth(repeats=10):
    """Bytes per second that one core reads and writes, both counted, in a long copy."""
    source = np.ones(COPIED_BYTES // 4, np.float32)
    target = np.empty_like(source)
    return 2.0 * COPIED_BYTES / best_cpu_s(lambda: np.copyto(target, source), repeats)
