"""Measure the one-step painter, painting and in training, each time in a process of its own."""

import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from statistics import median
from typing import Any

from tasks.measuring import measured

SLOWEST = "plain"
TRAINED_PRESETS = ("paper", "fast")


def measure_wiring(wiring: str, height_px: int, width_px: int, passes: int) -> dict[str, Any]:
    """Seconds per view and peak memory of one wiring, in this process.

    Args:
        wiring: its name.
        height_px: rows of the view, a multiple of 64 once padded.
        width_px: columns of the view.
        passes: views painted; all of them count, the first one too.
    """
    import torch

    from lidarpainter_models.painter.one_step.painter import STRIDE_PX
    from lidarpainter_models.painter.one_step.wirings import WIRINGS, build_wiring

    (known,) = (one for one in WIRINGS if one == wiring)
    rows, columns = (-(-size // STRIDE_PX) * STRIDE_PX for size in (height_px, width_px))
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(2, 1, 3, rows, columns, generator=generator)
    cpu_seconds, seconds = [], []
    with measured() as whole:
        paint = build_wiring(known)
        for _ in range(passes):
            started, cpu_started = time.perf_counter(), time.process_time()
            rgb = paint(images)
            cpu_seconds.append(time.process_time() - cpu_started)
            seconds.append(time.perf_counter() - started)
    return {
        "cpu_seconds": cpu_seconds,
        "seconds": seconds,
        "peak_bytes": whole.peak_memory_bytes,
        "image": torch.nn.functional.avg_pool2d(rgb[0], STRIDE_PX // 4).flatten().tolist(),
    }


def compare_wirings(
    height_px: int, width_px: int, rounds: int, passes: int = 1
) -> dict[str, dict[str, Any]]:
    """All wirings in turn, round after round, so that a busy machine is busy for all of them.

    Returns, by wiring: median `cpu_seconds` and `seconds` of a view and their lists, the largest
    `peak_bytes` of a process, how many times faster than `plain` by CPU seconds, and the mean
    absolute `difference_to_plain` of the images, averaged over 16x16 pixels.
    """
    from lidarpainter_models.painter.one_step.wirings import WIRINGS

    found: dict[str, list[dict[str, Any]]] = {wiring: [] for wiring in WIRINGS}
    for _ in range(rounds):
        for wiring in WIRINGS:
            found[wiring].append(
                _in_own_process(measure_wiring, wiring, height_px, width_px, passes)
            )
    slowest = _summary(found[SLOWEST])
    image = found[SLOWEST][0]["image"]
    return {
        wiring: _summary(runs)
        | {
            "times_faster": slowest["cpu_seconds"] / _summary(runs)["cpu_seconds"],
            "difference_to_plain": _difference(runs[0]["image"], image),
        }
        for wiring, runs in found.items()
    }


def measure_training(preset: str, height_px: int, width_px: int) -> dict[str, Any]:
    """Seconds of one training step with one view and peak memory, in this process.

    Args:
        preset: name of the wiring.
        height_px: rows of the view; padded to a multiple of 64.
        width_px: columns of the view.
    """
    from lidarpainter_models.painter.one_step.painter import STRIDE_PX
    from lidarpainter_models.painter.one_step.presets import preset_named
    from lidarpainter_models.painter.one_step.training_trial import build_trial

    rows, columns = (-(-size // STRIDE_PX) * STRIDE_PX for size in (height_px, width_px))
    with measured() as whole:
        step = build_trial(preset_named(preset), rows, columns)
        started, cpu_started = time.perf_counter(), time.process_time()
        loss = step()
        cpu_seconds, seconds = time.process_time() - cpu_started, time.perf_counter() - started
    return {
        "cpu_seconds": cpu_seconds,
        "seconds": seconds,
        "peak_bytes": whole.peak_memory_bytes,
        "loss": loss,
    }


def compare_training(height_px: int, width_px: int) -> dict[str, dict[str, Any]]:
    """One training step of every preset in `TRAINED_PRESETS`; see `measure_training`."""
    return {
        preset: _in_own_process(measure_training, preset, height_px, width_px)
        for preset in TRAINED_PRESETS
    }


def _in_own_process(
    measure: Callable[..., dict[str, Any]], *arguments: str | int
) -> dict[str, Any]:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=context) as pool:
        return pool.submit(measure, *arguments).result()


def _summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    cpu_seconds = [one for run in runs for one in run["cpu_seconds"]]
    seconds = [one for run in runs for one in run["seconds"]]
    return {
        "cpu_seconds": median(cpu_seconds),
        "seconds": median(seconds),
        "peak_bytes": max(run["peak_bytes"] for run in runs),
        "all_cpu_seconds": cpu_seconds,
        "all_seconds": seconds,
    }


def _difference(one: list[float], other: list[float]) -> float:
    return sum(abs(a - b) for a, b in zip(one, other, strict=True)) / len(one)
