"""What the one-step painter costs at full size, with random weights in bfloat16 or with none.

    python tests/benchmarks/bench_one_step.py costs [--preset paper] [--size 1024x576]
    python tests/benchmarks/bench_one_step.py views [--size 512x288] [--rounds 2]
    python tests/benchmarks/bench_one_step.py training [--size 512x288]

`costs` counts parameters, arithmetic and bytes on the meta device; `views` times the painter wired
plainly, wired well, and with the tiny autoencoder; `training` times a step. Each measurement has a
process of its own.
"""

import argparse
import json
import time
from statistics import median
from typing import Any

import torch
from one_step_costs import describe_wiring
from one_step_training_step import build_training_step
from one_step_wirings import WIRINGS, build_wiring
from own_process import in_own_process

from lidarpainter_models.painter.one_step.config import PRESETS
from lidarpainter_models.painter.one_step.painter import STRIDE_PX
from tasks.measuring import measured

SLOWEST = "plain"
TRAINED_PRESETS = ("paper", "fast")


def measure_wiring(wiring, height_px, width_px):
    """Seconds of a view, the first one, and peak memory of one wiring, in this process."""
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(2, 1, 3, *_padded(height_px, width_px), generator=generator)
    with measured() as whole:
        paint = build_wiring(wiring)
        started, cpu_started = time.perf_counter(), time.process_time()
        rgb = paint(images)
        cpu_s, wall_s = time.process_time() - cpu_started, time.perf_counter() - started
    coarse = torch.nn.functional.avg_pool2d(rgb[0], STRIDE_PX // 4)
    return {
        "cpu_s": cpu_s,
        "wall_s": wall_s,
        "peak_bytes": whole.peak_memory_bytes,
        "image": coarse.flatten().tolist(),
    }


def compare_wirings(height_px, width_px, rounds):
    """All wirings in turn, round after round, so that a busy machine is busy for all of them.

    By wiring: medians, the largest peak, how many times faster than `plain` by CPU seconds, and the
    mean absolute difference to its image, averaged over 16x16 pixels.
    """
    found: dict[str, list[dict[str, Any]]] = {wiring: [] for wiring in WIRINGS}
    for _ in range(rounds):
        for wiring in WIRINGS:
            found[wiring].append(in_own_process(measure_wiring, wiring, height_px, width_px))
    slowest_s = median(run["cpu_s"] for run in found[SLOWEST])
    image = found[SLOWEST][0]["image"]
    return {
        wiring: {
            "cpu_s": median(run["cpu_s"] for run in runs),
            "wall_s": median(run["wall_s"] for run in runs),
            "peak_bytes": max(run["peak_bytes"] for run in runs),
            "times_faster": slowest_s / median(run["cpu_s"] for run in runs),
            "difference_to_plain": sum(
                abs(ours - plain) for ours, plain in zip(runs[0]["image"], image, strict=True)
            )
            / len(image),
        }
        for wiring, runs in found.items()
    }


def measure_training(preset, height_px, width_px):
    """Seconds of one training step with one view and peak memory, in this process."""
    with measured() as whole:
        step = build_training_step(PRESETS[preset], *_padded(height_px, width_px))
        started, cpu_started = time.perf_counter(), time.process_time()
        loss = step()
        cpu_s, wall_s = time.process_time() - cpu_started, time.perf_counter() - started
    peak_bytes = whole.peak_memory_bytes
    return {"cpu_s": cpu_s, "wall_s": wall_s, "peak_bytes": peak_bytes, "loss": loss}


def _padded(height_px, width_px):
    return tuple(-(-size // STRIDE_PX) * STRIDE_PX for size in (height_px, width_px))


def _options():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    kinds = parser.add_subparsers(dest="kind", required=True)
    sizes = {"costs": "1024x576", "views": "512x288", "training": "512x288"}
    made = {kind: kinds.add_parser(kind) for kind in sizes}
    for kind, size in sizes.items():
        made[kind].add_argument("--size", default=size, help="WIDTHxHEIGHT of a view")
    made["costs"].add_argument("--preset", choices=PRESETS, default="paper")
    made["views"].add_argument("--rounds", type=int, default=2, help="processes a wiring, in turn")
    return parser.parse_args()


def main():
    options = _options()
    width_px, height_px = map(int, options.size.split("x"))
    if options.kind == "costs":
        found = describe_wiring(PRESETS[options.preset], height_px=height_px, width_px=width_px)
    elif options.kind == "views":
        found = compare_wirings(height_px, width_px, options.rounds)
    else:
        found = {
            preset: in_own_process(measure_training, preset, height_px, width_px)
            for preset in TRAINED_PRESETS
        }
    print(json.dumps(found, indent=1, default=str))  # noqa: T201 - a script


if __name__ == "__main__":
    main()
