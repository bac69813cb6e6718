"""How fast the kernels are, as multiples of what this machine could do at best.

    python tests/benchmarks/suite.py [--quick] [--save] [--out FILE]

Times are CPU milliseconds of the process, the best of several runs: on a shared machine the best is
what the code costs and the rest is what others took. Only the speed-up of two threads is wall time;
it means something on idle cores alone. Ratios last on other machines and are compared with
`baseline.json` (`--save` writes it); milliseconds are not. `--quick`
measures everything on small scenes.
"""

import argparse
import json
import os
from dataclasses import dataclass
from pathlib import Path

# read when numba and OpenMP are imported
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp workqueue tbb")

import torch
from bench_iteration import frame_growth_figures, iteration_figures, memory_figures
from bench_machine import copy_bandwidth, fma_peak_flops
from bench_points import point_figures
from bench_raster import (
    REFERENCE_SCENE,
    growth_figures,
    raster_figures,
    reference_figures,
    thread_figures,
)
from bench_rays import ray_figures
from bench_records import Figure, baseline_of, kept_to, table, write_figures
from bench_twins import twin_figures
from rich.console import Console

BASELINE = Path(__file__).with_name("baseline.json")
SCENE = (100_000, 960, 640)
QUICK_SCENE = (3_000, 160, 96)


@dataclass(frozen=True)
class Machine:
    """One core's peaks."""

    flops: float
    bandwidth: float

    def figures(self):
        """The peaks as figures."""
        return [
            Figure(
                name="machine.fma_peak", value=self.flops / 1e9, unit="GFLOP/s", better="higher"
            ),
            Figure(
                name="machine.copy_bandwidth",
                value=self.bandwidth / 1e9,
                unit="GB/s",
                better="higher",
            ),
        ]


def measure(*, quick):
    """All figures; quick ones mean nothing but that the suite works."""
    torch.set_num_threads(1)
    machine = Machine(fma_peak_flops(5 if quick else 20), copy_bandwidth(2 if quick else 10))
    if quick:
        scene, small = QUICK_SCENE, {"size": QUICK_SCENE}
        growing = {"gaussians": (1000, 2000), "sizes": ((80, 48), (160, 96)), "on_pixels": 1000}
        return [
            *machine.figures(),
            *raster_figures(machine, scene, 1),
            *reference_figures(scene, 1),
            *thread_figures(scene, 1),
            *iteration_figures(machine, 1, **small),
            *twin_figures(1, **small),
            *growth_figures(1, **growing),
            *frame_growth_figures(1, blocks=(1, 2), **small),
            *memory_figures(**small),
            *point_figures(machine, 1, counts=(1000, 2000)),
            *ray_figures(machine, 1, num_gaussians=500, keep_every=50),
        ]
    return [
        *machine.figures(),
        *raster_figures(machine, SCENE, 15),
        *thread_figures(SCENE, 15),
        *reference_figures(REFERENCE_SCENE, 7),
        *iteration_figures(machine, 15),
        *twin_figures(15),
        *point_figures(machine, 9),
        *ray_figures(machine, 7),
        *growth_figures(3),
        *frame_growth_figures(48),
        *memory_figures(),
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small scenes, a few seconds")
    parser.add_argument("--save", action="store_true", help="make this the baseline")
    parser.add_argument("--out", type=Path, default=Path("benchmarks.json"))
    options = parser.parse_args()
    figures = measure(quick=options.quick)
    baseline = json.loads(BASELINE.read_text("utf-8")) if BASELINE.exists() else {}
    title = "CPU ms, best of several; ratio = value / floor; baseline ratios in brackets"
    Console(width=170).print(table(figures, {} if options.quick else baseline, title))
    write_figures(options.out, figures)
    if options.save:
        BASELINE.write_text(json.dumps(baseline_of(figures), indent=2) + "\n", "utf-8")
    missed = [figure.name for figure in figures if kept_to(figure).startswith("MISSED")]
    if missed and not options.quick:
        Console(stderr=True).print(f"missed: {', '.join(missed)}")


if __name__ == "__main__":
    main()
