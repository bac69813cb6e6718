"""What a view of a finished run costs: rendered, and painted all in all.

    PYTHONPATH=. python tests/benchmarks/view_costs.py STORE [--run latest] [--views 24]
        [--painter nano]

Renders held-out views of the loaded scene, and paints them 2 m to the left (render, LiDAR image,
source views, warps, painting). Prints CPU milliseconds a view: the median of renders, the mean of
paintings, since the first ones prepare source views that later ones share.
"""

import argparse
import statistics
import sys
import time
from pathlib import Path

import torch

from catalog.store import open_store
from flows.parameters import view_parameters
from lidarpainter_models.geometry.shifts import Shift
from tasks.evaluation.shown import shown_scene
from tasks.opened import opened
from tasks.runs import open_run


def cpu_ms(work):
    """CPU milliseconds of one call."""
    began_s = time.process_time()
    work()
    return 1e3 * (time.process_time() - began_s)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("store", type=Path)
    parser.add_argument("--run", default="latest")
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--painter", default="nano")
    options = parser.parse_args()
    torch.set_num_threads(1)
    store = open_store(options.store)
    finished = open_run(store, options.run)
    parameters = view_parameters(finished)
    this = opened(parameters.run_spec(store.root, painter=options.painter))
    judged = parameters.evaluation_config
    shown = shown_scene(store, finished.final, judged.conditions, this.painter, this.device)
    held_out = this.held_out(judged.observation, or_train=True).sampled(options.views)
    views, beside = held_out.test_views, Shift(lateral_m=2.0)
    rendered, painted = [], []
    for view in (views[0], *views):  # the first loads kernels and is not counted
        camera = held_out.camera_of(shown.scene, view, "interpolated")
        aside = held_out.shifted_camera(shown.scene, view, beside)
        paint, when = shown.renderer(view.camera_name), view.timestamp_ns
        rendered.append(cpu_ms(lambda: shown.scene.render(camera, when)))  # noqa: B023
        painted.append(cpu_ms(lambda: paint(aside, when)))  # noqa: B023
    camera = held_out.camera_of(shown.scene, views[0], "interpolated")
    sys.stdout.write(
        f"{camera.width_px} x {camera.height_px} px, {shown.scene.num_gaussians} Gaussians, "
        f"{len(shown.scene.actors.recorded_tracks)} actors, {len(views)} views: "
        f"{statistics.median(rendered[1:]):.0f} ms a render, "
        f"{statistics.mean(painted[1:]):.0f} ms a painted view\n"
    )


if __name__ == "__main__":
    main()
