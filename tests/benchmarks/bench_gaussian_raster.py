"""How fast the rasteriser is: forward, backward, against the reference, on two threads.

    python tests/benchmarks/bench_gaussian_raster.py [--reference] [--save]

Times are milliseconds of CPU (all threads), the best of several runs; only the speed-up is wall
time, which means something on idle cores alone. `--reference` also times plain torch (20 s);
`--save` writes the table to the baseline that later runs are compared with.
"""

import argparse
import json
import time
from pathlib import Path

import numba
import torch
from rich.console import Console
from rich.table import Table

from lidarpainter_models.kernels.gaussian_raster import render_gaussians

BASELINE = Path(__file__).with_name("gaussian_raster_baseline.json")
SCENES = {
    "20k 480x320": (20_000, 480, 320),
    "80k 480x270": (80_000, 480, 270),
    "100k 960x640": (100_000, 960, 640),
}
REFERENCE_SCENE = "20k 480x320"
LEARNED = ("means", "rotation_wxyz", "scale_m", "opacity", "sh", "camera_from_body")


def street_like_splats(count, width_px, height_px):
    """Gaussians of degree 3 that fill the picture, near ones rarer, each about as wide on it."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    focal_px = 0.6 * width_px
    z = 3.0 + 57.0 * uniform(count) ** 1.5
    x = (uniform(count) - 0.5) * width_px / focal_px * z
    y = (uniform(count) - 0.5) * height_px / focal_px * z
    size_px = 0.75 * (width_px * height_px / count) ** 0.5
    splats = {
        "means": torch.stack([x, y, z], dim=1),
        "rotation_wxyz": normal(count, 4),
        "scale_m": torch.exp(0.5 * normal(count, 3)) * (size_px * z / focal_px)[:, None],
        "opacity": torch.sigmoid(1.5 * normal(count)),
        "sh": 0.3 * normal(count, 16, 3),
        "body_index": torch.zeros(count, dtype=torch.int32),
        "camera_from_body": torch.eye(4)[None],
    }
    for name in LEARNED:
        splats[name].requires_grad_()
    camera = {"fx_px": focal_px, "fy_px": focal_px, "width_px": width_px, "height_px": height_px}
    return splats | camera | {"cx_px": width_px / 2, "cy_px": height_px / 2}


def timed(splats, backend, repeats):
    """Best CPU ms forward and backward, and best wall ms of both together."""
    best = [float("inf")] * 3
    for _ in range(repeats):
        cpu, wall = time.process_time(), time.perf_counter()
        image = render_gaussians(**splats, backend=backend)
        loss = image.rgb.square().sum() + 0.01 * image.depth_m.sum() + image.alpha.sum()
        between = time.process_time()
        loss.backward()
        taken = (
            between - cpu,
            time.process_time() - between,
            time.perf_counter() - wall,
        )
        best = [min(old, 1e3 * new) for old, new in zip(best, taken, strict=True)]
    return best


def measure(name, with_reference):
    """One row of the table."""
    splats = street_like_splats(*SCENES[name])
    row = {}
    timed(splats, "cpu", 1)  # compiles, or loads what was compiled
    walls = {}
    for threads in (1, 2):
        if threads > numba.config.NUMBA_NUM_THREADS:
            continue
        numba.set_num_threads(threads)
        forward, backward, walls[threads] = timed(splats, "cpu", 12)
        if threads == 1:
            row["forward_ms"], row["backward_ms"] = round(forward, 1), round(backward, 1)
    if 2 in walls:
        row["two_thread_speedup"] = round(walls[1] / walls[2], 2)
    if with_reference and name == REFERENCE_SCENE:
        forward, backward, _ = timed(splats, "reference", 2)
        ours = row["forward_ms"] + row["backward_ms"]
        row["times_reference"] = round((forward + backward) / ours, 1)
    return row


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--reference", action="store_true", help="also time plain torch")
    parser.add_argument("--save", action="store_true", help="make this the baseline")
    options = parser.parse_args()
    torch.set_num_threads(1)
    baseline = json.loads(BASELINE.read_text("utf-8")) if BASELINE.exists() else {}
    columns = ("forward_ms", "backward_ms", "two_thread_speedup", "times_reference")
    table = Table("scene", *columns, title="Gaussian rasteriser on the CPU (baseline in brackets)")
    rows = {}
    for name in SCENES:
        row = rows[name] = measure(name, options.reference)
        old = baseline.get(name, {})
        table.add_row(name, *(f"{row.get(c, '-')} ({old.get(c, '-')})" for c in columns))
    Console().print(table)
    if options.save:
        BASELINE.write_text(json.dumps(rows, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
