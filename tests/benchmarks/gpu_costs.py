"""What rendering, fitting and painting take on a device: milliseconds and memory.

Without a GPU everything is small and the networks tiny: a rehearsal of the code, not a figure.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import kernel_trials
import torch
from gpu_findings import Cost, Findings, StepPart
from random_conditions import random_conditions
from smooth_pairs import MemoryPairs, smooth_pair
from torch.autograd import DeviceType
from torch.profiler import profile, supported_activities

import lidarpainter_models as lp
from lidarpainter_models.errors import WeightsError
from lidarpainter_models.kernels.backends import Backend, available_backends
from lidarpainter_models.painter.augmentation import AugmentationConfig
from lidarpainter_models.painter.nano.training import NanoTrainingConfig, train_nano
from lidarpainter_models.painter.selection import PainterChoice
from tasks.measuring import measured

RASTER_SIZES = ((100_000, 960, 640), (400_000, 1024, 576))
REHEARSED_RASTER_SIZES = ((2000, 96, 64),)
PRESETS = ("paper", "fast")
PAINTED_PX = (576, 1024)
REHEARSED_PAINTED_PX = (64, 128)


def cost_of(what: str, run: Callable[[], object], device: torch.device, repeats: int = 10) -> Cost:
    """Run it once, and then so many times."""
    is_gpu = device.type == "cuda"
    if is_gpu:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
    with measured() as whole:
        times_s = [_seconds(run, device) for _ in range(1 + repeats)]
    peak_bytes = torch.cuda.max_memory_allocated(device) if is_gpu else whole.peak_memory_bytes
    return Cost(
        what=what, first_ms=1e3 * times_s[0], ms=1e3 * median(times_s[1:]), peak_bytes=peak_bytes
    )


def _seconds(run: Callable[[], object], device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    started = time.perf_counter()
    run()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - started


def measure_rasterisers(findings: Findings, device: torch.device) -> None:
    """Images with all gradients, by every fast backend of the device."""
    is_gpu = device.type == "cuda"
    fast: tuple[Backend, ...] = ("cuda", "triton") if is_gpu else ("cpu",)
    for backend in [name for name in fast if name in available_backends("gaussian_raster")]:
        for size in RASTER_SIZES if is_gpu else REHEARSED_RASTER_SIZES:
            count, width_px, height_px = size
            what = f"draw and go back, {count} Gaussians, {width_px}x{height_px}, {backend}"
            with findings.part(what):
                scene = kernel_trials.raster_scene(size, device)
                run = partial(kernel_trials.draw_and_go_back, scene, backend)
                findings.costs.append(cost_of(what, run, device))


def measure_stages(findings: Findings, device: torch.device) -> None:
    """A small street through fit, render, conditions and the small painter."""
    is_gpu = device.type == "cuda"
    width_px, height_px = (480, 270) if is_gpu else (96, 54)
    count, steps = (60_000, 200) if is_gpu else (1500, 10)
    with findings.part("stages of a street"), TemporaryDirectory() as folder:
        street = lp.SyntheticStreetConfig(
            seed=5, num_frames=4, samples_per_axis=1, width_px=width_px, height_px=height_px
        )
        scene = lp.open_scene(lp.write_street(street, Path(folder)))
        split = lp.split_views(scene, "alternate", ("front_camera",))
        observation = lp.ObservationConfig(width_px=width_px)
        seen = lp.prepare_observations(scene, split, observation)
        config = lp.FitConfig(steps=steps, log_every=steps)
        config = _with_gaussians(config, count)
        fitted = lp.fit_gaussians(seen, config, device=device).scene
        name = f"{width_px}x{height_px}"

        def add(what: str, run: Callable[[], object], repeats: int, of: int = 1) -> None:
            cost = cost_of(f"{what}, {name}", run, device, repeats)
            findings.costs.append(cost.of_one(of))

        again = partial(lp.fit_gaussians, seen, config, start=fitted, device=device)
        add(f"a step of a fit, {len(fitted.gaussians)} Gaussians", again, 1, steps)
        findings.step = parts_of_a_step(again, steps, device)
        view = seen.views[1]
        add("render", partial(fitted.render, view.camera, view.timestamp_ns), 5)
        aside = lp.camera_beside(fitted, scene, view, lp.Shift(lateral_m=2.0))
        known = lp.ConditionBuilder(fitted, seen.lidar_map, seen.views)
        add("what is known of a view", partial(known.conditions, aside, view.timestamp_ns), 3)


def parts_of_a_step(run: Callable[[], object], steps: int, device: torch.device) -> list[StepPart]:
    """What some steps launch on a device (operations of torch on the CPU), the longest first."""
    is_gpu = device.type == "cuda"
    with profile(activities=list(supported_activities())) as trace:
        run()
    wanted = DeviceType.CUDA if is_gpu else DeviceType.CPU
    found = [event for event in trace.key_averages() if event.device_type == wanted]
    parts = [
        StepPart(
            kernel=event.key,
            launches=event.count / steps,
            ms=(event.self_device_time_total if is_gpu else event.self_cpu_time_total)
            / 1e3
            / steps,
        )
        for event in found
    ]
    return sorted(parts, key=lambda part: part.ms, reverse=True)


def _with_gaussians(config: lp.FitConfig, count: int) -> lp.FitConfig:
    return replace(
        config,
        initialisation=replace(config.initialisation, num_gaussians=count),
        densification=replace(config.densification, budget=count),
    )


def measure_painters(findings: Findings, device: torch.device, model: str | None) -> None:
    """One view by the small painter and by presets of the one-step painter."""
    height_px, width_px = PAINTED_PX if device.type == "cuda" else REHEARSED_PAINTED_PX
    known = kernel_trials.moved(random_conditions(height_px, width_px), device)
    size = f"{width_px}x{height_px}"
    with findings.part("painter nano"), torch.inference_mode():
        painter = PainterChoice.of("nano").load(device)
        run = partial(painter.paint, known)
        findings.painters.append(cost_of(f"nano, {size}", run, device, 5))
    measure_training(findings, device)
    for preset in PRESETS:
        if find_spec("diffusers") is None:
            findings.unchecked.append(f"painter {preset}: diffusers is not installed")
            continue
        with findings.part(f"painter {preset}"):
            painter, weights = one_step_painter(preset, device, model)
            run = partial(painter.paint, known)
            what = f"{preset} ({weights}), {size}"
            findings.painters.append(cost_of(what, run, device, 5))
            del painter, run


def measure_training(findings: Findings, device: torch.device) -> None:
    """A step of training the small painter, batches drawn as in a real training.

    The first time counts the start of the processes that draw, the later one does not.
    """
    side_px, batch, steps = (192, 32, 100) if device.type == "cuda" else (32, 2, 4)
    source = MemoryPairs([smooth_pair(side_px, seed) for seed in range(4)])
    recipe = NanoTrainingConfig(
        augmentation=AugmentationConfig(crop_px=side_px),
        batch_size=batch,
        steps=steps,
        log_every_steps=steps // 4,
    )
    quarters_s: list[float] = []

    def train() -> None:
        quarters_s.clear()
        train_nano(
            [source],
            recipe,
            device=device,
            progress=lambda _: quarters_s.append(time.perf_counter()),
        )

    with findings.part("training of nano"):
        what = f"a training step of nano, {batch} windows of {side_px} px"
        cost = cost_of(what, train, device, 1).of_one(steps)
        step_s = (quarters_s[-1] - quarters_s[0]) / (3 * recipe.log_every_steps)
        findings.painters.append(replace(cost, ms=1e3 * step_s))


def one_step_painter(preset, device, model):
    """The painter, and whether its weights are a model's or random, which take as long."""
    if model is not None:
        try:
            return PainterChoice.of(f"{model}:{preset}").load(device), "trained weights"
        except WeightsError as error:
            raise WeightsError(f"{model}: {error}") from None
    from random_diffusion import random_network
    from tiny_diffusion import TINY
    from turbo_shapes import SD_TURBO

    from lidarpainter_models.painter.one_step.architectures import TEXT_TOKENS
    from lidarpainter_models.painter.one_step.assembly import merge_lora
    from lidarpainter_models.painter.one_step.config import PRESETS
    from lidarpainter_models.painter.one_step.painter import OneStepPainter
    from lidarpainter_models.painter.one_step.prompts import PromptBook
    from lidarpainter_models.painter.protocol import DEFAULT_PROMPT

    is_gpu = device.type == "cuda"
    architecture = SD_TURBO if is_gpu else TINY
    dtype = torch.bfloat16 if is_gpu else torch.float32
    network = random_network(
        PRESETS[preset], architecture=architecture, dtype=dtype, has_adapters=True
    )
    text = torch.zeros(TEXT_TOKENS, architecture.text_width, dtype=dtype)
    merge_lora(network)
    painter = OneStepPainter(network, PromptBook({DEFAULT_PROMPT: text}), {})
    return painter.to(device), "random weights" if is_gpu else "tiny network"
