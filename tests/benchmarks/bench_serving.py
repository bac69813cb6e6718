"""What a served image costs: a pinhole, distorted lenses, and saying how far each can be trusted.

    PYTHONPATH=.:tests/support python tests/benchmarks/bench_serving.py [--quick]

CPU milliseconds of the process, the best of several runs, of the scene that a fit of a small street
starts with; rays of a lens are found before.
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from functools import partial
from math import radians
from pathlib import Path

from bench_machine import best_cpu_s
from served_street import ServedStreet
from tiny_street import tiny_street

from lidarpainter_models.serving.lens_models import PinholeLens, RadialLens, RisingCurve
from lidarpainter_models.serving.messages import read_request

SIZE, QUICK_SIZE = (480, 270), (96, 54)
NUM_GAUSSIANS, QUICK_GAUSSIANS = 60_000, 2000
HALF_RAD = radians(95)


def lenses(width_px):
    """A lens of each kind, as wide as the image or wider, by what it is called."""
    focal_px = 0.7 * width_px
    fisheye = RadialLens(RisingCurve((0.0, 1.0, 0.0, -0.02), HALF_RAD), True, HALF_RAD)
    ftheta = RadialLens(RisingCurve((0.0, focal_px, 0.0, -0.03 * focal_px), 1.3), True, 1.3)
    return {
        "rational": (PinholeLens((-0.25, 0.08, -0.01, 0.02)), focal_px),
        "f-theta": (ftheta, 1.0),
        "fisheye of 190 degrees": (fisheye, 0.3 * width_px),
    }


def main(*, is_quick):
    """Print a line for each kind of image."""
    size, count = (QUICK_SIZE, QUICK_GAUSSIANS) if is_quick else (SIZE, NUM_GAUSSIANS)
    config = tiny_street(width_px=size[0], height_px=size[1], num_frames=4)
    with tempfile.TemporaryDirectory() as folder:
        street = ServedStreet(Path(folder), street=config, num_gaussians=count)
    view = street.recording.views_of("front_camera")[2]
    request, served = read_request(street.request(view)), street.served
    unmeasured = replace(served, is_measured=False)
    cases = {"trust alone": partial(served.trust, request)}
    cases["pinhole"] = partial(unmeasured.frame, request)
    for name, (lens, focal_px) in lenses(size[0]).items():
        matrix = (focal_px, 0.0, 0.0, focal_px)
        camera = replace(request.camera, lens=lens, pixels_per_unit=matrix)
        other = replace(request, camera=camera)
        cases[name] = partial(unmeasured.frame, other)
    for name, work in cases.items():
        work()
        taken_ms = 1e3 * best_cpu_s(work, 3 if is_quick else 7)
        sys.stdout.write(f"{name}: {taken_ms:.1f} ms\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    main(is_quick=parser.parse_args().quick)
