"""Wait for what other processes bring about."""

import time


def until(holds, *, seconds=60.0):
    """What a function gives as soon as that is something."""
    end = time.monotonic() + seconds
    while not (found := holds()):
        assert time.monotonic() < end, "it never came"
        time.sleep(0.1)
    return found
