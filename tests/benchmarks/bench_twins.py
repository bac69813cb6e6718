"""Plain torch against numba: a step of a fit without its rasteriser, which both have from numba.

As a program it prints both and what each kernel of the step takes:

    PYTHONPATH=tests/support python tests/benchmarks/bench_twins.py
"""

import importlib
import os
import time
from collections import defaultdict
from dataclasses import replace
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch
from bench_iteration import SIZE, Fit
from bench_records import Figure
from rich.console import Console
from rich.table import Table

from lidarpainter_models.kernels.backends import RASTERISER, implementation, kernels_chosen
from lidarpainter_models.kernels.pixel_losses import SKY

KERNELS = (RASTERISER, "sparse_adam", "sky_texture", "frustum_culling", "pixel_losses", "ssim")
MOST = 3.0
"""Times that the twins may cost, so that a run without numba's help is worth trying on a CPU."""
SKY_SHARE = 1 / 3
"""Upper part of the image that is sky, as in a street."""


class Timed:
    """CPU seconds of each kernel, and of backward passes, while it is patched in."""

    def __init__(self):
        self.spent_s = defaultdict(list)

    def implementation(self, kernel, function, *which, **kind):
        """In place of `implementation`: the function, timed."""
        found = implementation(kernel, function, *which, **kind)
        return self.timed(f"{kernel}.{function}", found)

    def timed(self, name, function):
        """The function, its CPU seconds kept under a name."""

        def call(*args, **options):
            begun = time.process_time()
            result = function(*args, **options)
            self.spent_s[name].append(time.process_time() - begun)
            return result

        return call


def fit_with_sky(size):
    """A fit whose image has sky in its upper part."""
    fit = Fit(*size, start_step=0)
    image = fit.images[0]
    kind = image.kind.clone()
    kind[: round(SKY_SHARE * kind.shape[0])] = SKY
    fit.images = [replace(image, kind=kind)]
    return fit


def step_times(choice, repeats, size=SIZE):
    """Least CPU milliseconds of a step by part: its kernels, `backward`, the raster's, `step`."""
    timed = Timed()
    doors: list[Any] = [
        importlib.import_module(f"lidarpainter_models.kernels.{name}") for name in KERNELS
    ]
    raster = importlib.import_module("lidarpainter_models.kernels.gaussian_raster.cpu")
    kept = torch.autograd.backward, raster._DrawView.backward
    try:
        for door in doors:
            door.implementation = timed.implementation
        torch.autograd.backward = timed.timed("backward", kept[0])
        raster._DrawView.backward = staticmethod(timed.timed("raster backward", kept[1]))
        with kernels_chosen(choice):
            fit = fit_with_sky(size)
            step = timed.timed("step", fit.step)
            for _ in range(repeats + 3):
                step()
    finally:
        for door in doors:
            door.implementation = implementation
        torch.autograd.backward, raster._DrawView.backward = kept[0], staticmethod(kept[1])
    return {name: 1e3 * min(spent[3:]) for name, spent in timed.spent_s.items()}


def without_raster(times):
    """Milliseconds of a step but for drawing and its gradient."""
    return times["step"] - times[f"{RASTERISER}.draw_view"] - times["raster backward"]


def twin_figures(repeats, *, size=SIZE):
    """What the twins of all kernels but the rasteriser cost, as a multiple of numba's."""
    numba, twins = (
        without_raster(step_times(choice, repeats, size)) for choice in ("auto", "torch")
    )
    return [
        Figure(
            name="iteration.twins", value=twins, unit="ms", floor=numba, backend="torch", limit=MOST
        )
    ]


def main():
    torch.set_num_threads(1)
    numba, twins = (step_times(choice, 15) for choice in ("auto", "torch"))
    table = Table("CPU ms", "numba", "torch", title="least of 15 steps")
    for name in twins:
        table.add_row(name, f"{numba.get(name, 0):.2f}", f"{twins[name]:.2f}")
    both = without_raster(numba), without_raster(twins)
    table.add_row("without the rasteriser", f"{both[0]:.1f}", f"{both[1]:.1f}")
    table.add_row("as a multiple", "1", f"{both[1] / both[0]:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
