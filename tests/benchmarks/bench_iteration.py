"""A step of the fit: against its kernels, on a scene four times as long, and its memory."""

import time
from pathlib import Path

import torch
from bench_machine import best_cpu_s
from bench_raster import STAGES, Stages
from bench_records import Figure
from bench_scenes import street_like_splats
from bench_work import ADAM_BYTES, SSIM_BYTES_PER_VALUE, SSIM_FLOP_PER_VALUE
from gaussian_world import LOOK_FORWARD, scene_of, training_view
from own_process import in_own_process
from splat_drawing import render

from lidarpainter_models.gaussians.fitting.config import FitConfig, RefinementConfig
from lidarpainter_models.gaussians.fitting.images import full_image
from lidarpainter_models.gaussians.fitting.state import FitState
from lidarpainter_models.gaussians.fitting.step import fit_step
from lidarpainter_models.gaussians.model.drawing import camera_from_body
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.geometry.transforms import rigid_from_rotation
from lidarpainter_models.kernels.ssim import l1_ssim_loss

SIZE = (30_000, 480, 320)
MEMORY_SIZE = (1_000_000, 960, 640)
BLOCK_M = 1000.0
"""Blocks of a long street lie this far behind each other, out of each other's view."""
FLOATS_PER_GAUSSIAN = 59


def street_scene(count, width_px, height_px, *, blocks=1):
    """`count` Gaussians before a camera in each block, the cameras being the training views."""
    splats = street_like_splats(count, width_px, height_px)
    cameras, sets = [], []
    for block in range(blocks):
        # each block looks away from the one before
        turn = torch.diag(torch.tensor([1.0, 1.0, 1.0]) if block % 2 == 0 else _BACKWARDS)
        rotation = turn @ LOOK_FORWARD
        place = torch.tensor([0.0, BLOCK_M * block, 1.0])
        cameras.append(splats["camera"].at(rigid_from_rotation(rotation, place).double()))
        sets.append(_placed(splats, rotation, place))
    gaussians = GaussianSet(**{name: torch.cat([s[name] for s in sets]) for name in sets[0]})
    return scene_of(gaussians, cameras), cameras


_BACKWARDS = torch.tensor([-1.0, -1.0, 1.0])


def _placed(splats, rotation, place):
    values = {name: value.detach() for name, value in splats.items() if torch.is_tensor(value)}
    return {
        "means": values["means"] @ rotation.T + place,
        "rotation_wxyz": values["rotation_wxyz"],
        "log_scale": values["scale_m"].log(),
        "opacity_logit": torch.logit(values["opacity"]),
        "sh_dc": values["sh"][:, :1].contiguous(),
        "sh_rest": values["sh"][:, 1:].contiguous(),
        "body_index": values["body_index"],
    }


def training_images(cameras):
    """A grey image with LiDAR depth in a tenth of the pixels for every camera."""
    generator = torch.Generator().manual_seed(1)
    images = []
    for frame, camera in enumerate(cameras):
        shape = (camera.height_px, camera.width_px)
        is_hit = torch.rand(shape, generator=generator) < 0.1
        depth_m = 3.0 + 57.0 * torch.rand(shape, generator=generator)
        rgb_u8 = torch.randint(0, 255, (*shape, 3), generator=generator, dtype=torch.uint8)
        shown = {"rgb_u8": rgb_u8, "lidar_depth_m": torch.where(is_hit, depth_m, 0.0)}
        images.append(full_image(training_view(camera, frame=frame, **shown)))
    return images


class Fit:
    """A running fit whose steps can be timed."""

    def __init__(self, count, width_px, height_px, *, blocks=1, start_step=100):
        scene, cameras = street_scene(count, width_px, height_px, blocks=blocks)
        self.config = FitConfig(steps=10_000, refinement=RefinementConfig(start_step=start_step))
        self.pixels = width_px * height_px
        self.state = FitState.begin(scene, self.config, self.pixels)
        self.images = training_images(cameras)
        self.view = 0

    def step(self):
        """What every step of a fit does, on one recorded view after the other."""
        fit_step(self.state, self.images[self.view], self.view)
        self.state.step += 1
        self.view = (self.view + 1) % len(self.images)


def iteration_figures(machine, repeats, *, size=SIZE):
    """A whole step, its render and loss against their kernels, and its fixed cost."""
    count, width, height = size
    splats = street_like_splats(*size)
    stages = Stages(splats)
    target = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(2))
    kernels_ms = sum(1e3 * best_cpu_s(getattr(stages, name), repeats) for name in STAGES)
    loss_ms = 1e3 * best_cpu_s(lambda: _loss(target, splats=None), repeats)
    whole_ms = 1e3 * best_cpu_s(lambda: _loss(target, splats=splats), repeats)
    values = 3 * width * height
    ssim_floor = max(
        values * SSIM_FLOP_PER_VALUE / machine.flops,
        values * SSIM_BYTES_PER_VALUE / machine.bandwidth,
    )
    fit, idle = Fit(*size), Fit(1, 16, 16)
    iteration_ms = 1e3 * best_cpu_s(fit.step, repeats)
    idle_ms = 1e3 * best_cpu_s(idle.step, repeats)
    adam_ms = 1e3 * best_cpu_s(_adam_of(fit), repeats)
    numbers = count * FLOATS_PER_GAUSSIAN
    return [
        Figure(name="ssim.forward_backward", value=loss_ms, unit="ms", floor=1e3 * ssim_floor),
        Figure(
            name="adam.step",
            value=adam_ms,
            unit="ms",
            floor=1e3 * numbers * ADAM_BYTES / machine.bandwidth,
        ),
        Figure(name="iteration", value=iteration_ms, unit="ms", floor=kernels_ms + loss_ms),
        Figure(
            name="iteration.render_and_loss",
            value=whole_ms,
            unit="ms",
            floor=kernels_ms + loss_ms,
            limit=1.3,
            tolerance=0.15,
        ),
        Figure(name="iteration.python_share", value=idle_ms / iteration_ms, unit="x", limit=0.05),
    ]


def _loss(target, *, splats):
    """The image loss and its gradient, of a drawn image or of a given one."""
    rgb = (target * 0.9).requires_grad_() if splats is None else render(splats, backend="cpu").rgb
    l1_ssim_loss(rgb, target).backward()


def _adam_of(fit):
    """The optimiser's step on everything that the fit's one view shows."""
    scene = fit.state.scene
    bodies = camera_from_body(
        scene.cameras.world_from_camera(0), *scene.actors.refined_poses_in_fit(0)
    )
    rows = fit.state.blocks.in_view([(fit.images[0].camera, bodies)]).nonzero()[:, 0]
    seen = fit.state.gaussian_adam.seen(scene.gaussians, rows)
    for leaf in (seen.means, seen.rotation_wxyz, seen.log_scale, seen.opacity_logit, seen.sh):
        leaf.grad = leaf.detach().clone()
    return lambda: fit.state.step_gaussians(seen)


def frame_growth_figures(rounds, *, blocks=(1, 4, 16), size=SIZE):
    """A street of many blocks against one: what is out of view is not to be paid for.

    The streets step in turns, so that a busy spell hits all. What is done between steps now and
    then (growing, limiting shapes, all Gaussians caught up) is not in it, but for the catching up.
    """
    fits = {count: Fit(*size, blocks=count) for count in blocks}
    for fit in fits.values():
        for _ in fit.images:  # every row is left once before it is seen again
            fit.step()
    taken = dict.fromkeys(blocks, float("inf"))
    for _ in range(rounds):
        for count, fit in fits.items():
            before = time.process_time()
            fit.step()
            taken[count] = min(taken[count], 1e3 * (time.process_time() - before))
    before = time.process_time()
    fits[blocks[-1]].state.caught_up()
    caught_up_ms = 1e3 * (time.process_time() - before)
    return [
        *(
            Figure(name=f"growth.frames.{count}", value=ms, unit="ms")
            for count, ms in taken.items()
        ),
        *(
            Figure(
                name=f"growth.frames.{count}_times",
                value=ms / taken[blocks[0]],
                unit="x",
                limit=1.15 if count == 4 else None,
            )
            for count, ms in taken.items()
            if count != blocks[0]
        ),
        Figure(name=f"adam.catch_up.{blocks[-1]}_blocks", value=caught_up_ms, unit="ms"),
    ]


def memory_figures(*, size=MEMORY_SIZE):
    """Peak memory of a step with so many Gaussians beyond parameters and Adam's moments."""
    extra = in_own_process(_extra_bytes, *size)
    return [Figure(name="memory.training_step", value=extra / 1e9, unit="GB", limit=1.5)]


def _extra_bytes(count, width_px, height_px):
    torch.set_num_threads(1)
    small = Fit(100, width_px, height_px)
    small.step()  # compiles and allocates what does not depend on the number of Gaussians
    del small
    before = _process_bytes("VmRSS")
    fit = Fit(count, width_px, height_px)
    # forget the peak of building the scene; what it left unreturned counts against the step
    Path("/proc/self/clear_refs").write_text("5", "ascii")
    fit.step()
    kept_bytes = count * FLOATS_PER_GAUSSIAN * 4 * 3  # parameters and two moments
    return _process_bytes("VmHWM") - before - kept_bytes


def _process_bytes(name):
    """A size from this process's status (proc(5))."""
    lines = Path("/proc/self/status").read_text("ascii").splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:"))
