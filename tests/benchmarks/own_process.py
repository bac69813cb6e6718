"""Measure something in a process of its own, whose memory and compiled code are its alone."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor


def in_own_process(measure, *arguments):
    """What a function of a module returns there."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=context) as pool:
        return pool.submit(measure, *arguments).result()
