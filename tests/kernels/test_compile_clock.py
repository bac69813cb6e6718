"""The clock counts what is compiled, once, and nothing that is only run."""

from numba import njit

from lidarpainter_models.kernels.compile_clock import CompileClock


def test_compiling_is_counted_and_running_is_not():
    inner = njit(lambda value: value + 1)
    outer = njit(lambda value: inner(value) + 1)
    clock = CompileClock()
    clock.start()
    try:
        assert outer(1) == 3
        compiled = clock.cpu_seconds
        assert compiled > 0
        outer(2)
        assert clock.cpu_seconds == compiled
    finally:
        clock.stop()
    outer(1.5)
    assert clock.cpu_seconds == compiled
