"""The rasteriser stage by stage: each against its floor, then the whole, two threads and growth."""

import time
from itertools import pairwise

import numba
import numpy as np
import torch
from bench_machine import best_cpu_s, multiply_adds
from bench_records import Figure
from bench_scenes import LEARNED, street_like_splats
from bench_work import BACKWARD_LANE_FLOP, FORWARD_LANE_FLOP, count_lanes, raster_bytes
from splat_drawing import render

from lidarpainter_models.kernels.gaussian_raster import cpu
from lidarpainter_models.kernels.gaussian_raster.binning import list_tiles
from lidarpainter_models.kernels.gaussian_raster.blending import Images, blend
from lidarpainter_models.kernels.gaussian_raster.blending_gradients import entry_sums
from lidarpainter_models.kernels.gaussian_raster.projection import IS_VISIBLE, project
from lidarpainter_models.kernels.gaussian_raster.projection_gradients import unproject

GAUSSIAN_GROWTH = (20_000, 40_000, 80_000, 160_000, 320_000, 640_000, 1_000_000)
PIXEL_GROWTH = ((400, 250), (560, 360), (800, 500), (1120, 720), (1600, 1000), (2000, 1000))


class Stages:
    """The compiled stages of one scene, each callable alone on what the one before made."""

    def __init__(self, splats):
        count = len(splats["means"])
        names = ("means", "rotation_wxyz", "scale_m", "opacity", "sh")
        tensors = tuple(splats[name] for name in names)
        tensors += (torch.zeros(count, 0), splats["camera_from_body"], splats["body_index"])
        self.gaussians = cpu._gaussians(tensors)
        self.view = cpu._compiled_view(splats["camera"])
        self.records = self.project()
        self.lists = self.list_tiles()
        self.drawn = self.blend()
        generator = np.random.default_rng(0)
        self.to_drawn = Images(
            *(generator.standard_normal(p.shape).astype(np.float32) for p in self.drawn)
        )
        self.slots = self.blend_gradients()

    def project(self):
        return project(self.gaussians, self.view)

    def list_tiles(self):
        return list_tiles(self.records, self.view.width, self.view.height)

    def blend(self):
        features = self.gaussians.features
        return blend(self.records, features, self.lists, self.view.width, self.view.height)

    def blend_gradients(self):
        features = self.gaussians.features
        return entry_sums(self.records, features, self.lists, self.drawn, self.to_drawn)

    def unproject(self):
        room = cpu._room_for_gradients(self.gaussians)
        unproject(self.gaussians, self.view, self.records, self.lists, self.slots, room)


STAGES = ("project", "list_tiles", "blend", "blend_gradients", "unproject")


REFERENCE_SCENE = (20_000, 480, 320)
LEAST_TIMES_REFERENCE = 25.0


def forward(splats):
    """One image, without what a backward pass needs."""
    with torch.no_grad():
        return render(splats, backend="cpu")


def step(splats, backend="cpu"):
    """One image and all gradients, not added to earlier ones."""
    image = render(splats, backend=backend)
    torch.autograd.grad(_loss(image), [splats[name] for name in LEARNED])


def _loss(image):
    return image.rgb.square().sum() + 0.01 * image.depth_m.sum() + image.alpha.sum()


def raster_figures(machine, size, repeats):
    """Every stage and the whole of one scene on one thread; times in milliseconds."""
    numba.set_num_threads(1)
    splats = street_like_splats(*size)
    stages = Stages(splats)
    lanes = count_lanes(stages.records, stages.lists, stages.view.height, stages.view.width)
    floors = _stage_floors(stages, lanes, machine)
    figures = []
    for name in STAGES:
        taken = 1e3 * best_cpu_s(getattr(stages, name), repeats)
        # the lane loops are held to multiply-adds alone, the other stages to memory
        limit = 4.0 if name in ("blend", "blend_gradients") else None
        figures.append(
            Figure(
                name=f"gaussian_raster.{name}",
                value=taken,
                unit="ms",
                floor=floors[name],
                limit=limit,
            )
        )
    forward_ms = 1e3 * best_cpu_s(lambda: forward(splats), repeats)
    step_ms = 1e3 * best_cpu_s(lambda: step(splats), repeats)
    forward_floor = sum(floors[name] for name in STAGES[:3])
    backward_floor = sum(floors[name] for name in STAGES[3:])
    return [
        Figure(name="gaussian_raster.forward", value=forward_ms, unit="ms", floor=forward_floor),
        Figure(
            name="gaussian_raster.backward",
            value=step_ms - forward_ms,
            unit="ms",
            floor=backward_floor,
        ),
        Figure(
            name="gaussian_raster.lanes_per_blend",
            value=lanes.evaluated / lanes.blended,
            unit="x",
            limit=2.6,
            tolerance=0.02,
        ),
        *figures,
    ]


def _stage_floors(stages, lanes, machine):
    """Milliseconds: multiply-adds of the lanes for the lane loops, bytes for the other stages."""
    count, visible = len(stages.records), int((stages.records[:, IS_VISIBLE] > 0).sum())
    pixels = stages.view.width * stages.view.height
    moved = raster_bytes(count, visible, len(stages.lists.gaussian), pixels)
    floors = {name: 1e3 * moved[name] / machine.bandwidth for name in STAGES}
    floors["blend"] = 1e3 * lanes.evaluated * FORWARD_LANE_FLOP / machine.flops
    floors["blend_gradients"] = 1e3 * lanes.evaluated * BACKWARD_LANE_FLOP / machine.flops
    return floors


def reference_figures(size, repeats):
    """How many times faster an image with its gradients is than by the plain reference."""
    numba.set_num_threads(1)
    splats = street_like_splats(*size)
    ours_s = best_cpu_s(lambda: step(splats), repeats)
    reference_s = best_cpu_s(lambda: step(splats, "reference"), 1)
    return [
        Figure(name="gaussian_raster.step_small", value=1e3 * ours_s, unit="ms"),
        Figure(
            name="gaussian_raster.times_reference",
            value=reference_s / ours_s,
            unit="x",
            better="higher",
            limit=LEAST_TIMES_REFERENCE,
        ),
    ]


def thread_figures(size, repeats):
    """Wall time of one thread over that of two, taken in turns so that a busy spell hits both.

    Beside it what the machine makes of two threads that share nothing: cores may be shared, too.
    """
    if vars(numba.config)["NUMBA_NUM_THREADS"] < 2:
        return []
    splats = street_like_splats(*size)
    works = {
        "machine.thread_speedup": multiply_adds,
        "gaussian_raster.thread_speedup": lambda: step(splats),
    }
    walls = {(name, threads): float("inf") for name in works for threads in (1, 2)}
    for _ in range(repeats):
        for name, threads in walls:
            numba.set_num_threads(threads)
            wall_s = best_cpu_s(works[name], 1, time.perf_counter)
            walls[name, threads] = min(walls[name, threads], wall_s)
    numba.set_num_threads(1)
    return [
        Figure(
            name=name,
            value=walls[name, 1] / walls[name, 2],
            unit="x",
            threads=2,
            better="higher",
            limit=None if name.startswith("machine") else 1.7,
        )
        for name in works
    ]


def growth_figures(repeats, *, gaussians=GAUSSIAN_GROWTH, sizes=PIXEL_GROWTH, on_pixels=100_000):
    """Time of a step at growing sizes; each as the growth per doubling of what grew.

    Images grow with `on_pixels` Gaussians in them.
    """
    by_count = {count: 1e3 * best_cpu_s(_step_of(count, 960, 640), repeats) for count in gaussians}
    by_pixels = {
        width * height: 1e3 * best_cpu_s(_step_of(on_pixels, width, height), repeats)
        for width, height in sizes
    }
    figures = doublings("growth.gaussians", by_count, "Gaussians")
    return figures + doublings("growth.pixels", by_pixels, "px")


def _step_of(count, width, height):
    splats = street_like_splats(count, width, height)
    return lambda: step(splats)


def doublings(name, taken_ms, unit):
    """The times, and for each pair of neighbours how much a doubling would have cost."""
    figures = [
        Figure(name=f"{name}.{amount}", value=ms, unit="ms") for amount, ms in taken_ms.items()
    ]
    for (few, fast), (many, slow) in pairwise(taken_ms.items()):
        per_doubling = (slow / fast) ** (np.log(2.0) / np.log(many / few))
        figures.append(
            Figure(
                name=f"{name}.doubling.{few}-{many}_{unit}",
                value=float(per_doubling),
                unit="x",
                limit=2.2,
            )
        )
    return figures
