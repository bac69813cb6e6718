"""What a fit costs of a car that stands for long, and of a street four times as long.

    PYTHONPATH=. python tests/benchmarks/bench_length.py [--width 320] [--quick]

Each log is a synthetic street with its front camera and LiDAR, prepared and fitted at `preview` in
a process of its own, set up as the command sets up its own, every view used. Prints Gaussians,
steps, time, the most memory that preparing or fitting took, and their ratios. `--quick` takes a
tenth of the frames and four steps, and means nothing but that the program works.
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from own_process import in_own_process

from flows.environment import prepare_environment
from flows.presets import preview
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.gaussians.fitting.plan import planned_settings
from lidarpainter_models.gaussians.fitting.seen_surface import seen_surface
from lidarpainter_models.observations.preparation import prepare_observations
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.splits import split_views
from lidarpainter_models.synthetic import SyntheticStreetConfig, write_street
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS
from tasks.measuring import measured

SEED = 16
LOGS = {
    "stands, 20 frames": (20, 0.0),
    "stands, 200 frames": (200, 0.0),
    "drives 19 m, 20 frames": (20, 10.0),
    "drives 79 m, 80 frames": (80, 10.0),
}
"""Frames, and metres a second."""
COMPARED = (
    ("stands, 200 frames", "stands, 20 frames"),
    ("drives 79 m, 80 frames", "drives 19 m, 20 frames"),
)
FIGURES = ("gaussians", "steps", "prepare_cpu_s", "fit_cpu_s", "fit_s", "peak_bytes")


def written(name, width_px, folder, *, quick):
    """Write one log; its scene's folder."""
    frames, speed_mps = LOGS[name]
    frames = frames // 10 if quick else frames
    street = SyntheticStreetConfig(
        seed=SEED,
        num_frames=frames,
        width_px=width_px,
        height_px=width_px * 9 // 16,
        samples_per_axis=1,
        cameras=DEFAULT_CAMERAS[:1],
        speed_mps=(speed_mps, speed_mps),
    )
    return write_street(street, folder)


def costs_of(folder, width_px, quick):
    """Prepare and fit one log; its figures."""
    prepare_environment()
    chosen = preview("synthetic/street")
    fit = replace(chosen.fit, steps=4) if quick else chosen.fit
    observation = replace(chosen.observation, width_px=width_px)
    scene = DrivingScene.open(folder)
    with measured() as preparing:
        seen = prepare_observations(scene, split_views(scene, "all"), observation)
    plan = planned_settings(fit, seen_surface(seen.views))
    with measured() as fitting:
        fitted = fit_gaussians(seen, fit).scene
    return {
        "gaussians": fitted.num_gaussians,
        "steps": plan.steps,
        "prepare_cpu_s": preparing.cpu_seconds,
        "fit_cpu_s": fitting.cpu_seconds,
        "fit_s": fitting.seconds,
        "peak_bytes": max(preparing.peak_memory_bytes, fitting.peak_memory_bytes),
    }


def in_its_own_process(name, width_px, *, quick):
    """As `costs_of`; peaks of memory are a process's, and another one writes the log."""
    with tempfile.TemporaryDirectory() as place:
        folder = written(name, width_px, Path(place), quick=quick)
        return in_own_process(costs_of, folder, width_px, quick)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--quick", action="store_true", help="few frames and steps")
    options = parser.parse_args()
    prepare_environment()  # memory here, and threads of the processes that this one starts
    costs = {name: in_its_own_process(name, options.width, quick=options.quick) for name in LOGS}
    rows = [
        (name, [f"{found[figure]:,.0f}" for figure in FIGURES]) for name, found in costs.items()
    ]
    rows += [
        (
            f"... over {short}",
            [f"{costs[long][figure] / costs[short][figure]:.2f}" for figure in FIGURES],
        )
        for long, short in COMPARED
    ]
    for name, cells in (("", FIGURES), *rows):
        sys.stdout.write(f"{name:32s}" + "".join(f"{cell:>18s}" for cell in cells) + "\n")


if __name__ == "__main__":
    main()
