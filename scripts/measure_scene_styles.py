"""What a style in a scene costs: flicker, edges and time of rendering, against the clear scene.

    python scripts/measure_scene_styles.py STORE RUN [STYLE ...]

Views are those of every recorded frame of the first trained camera. Flicker is that of `evaluate
--protocol flicker`, edges as `stylize --json` has them, times are CPU seconds: every frame is
rendered in both scenes in turn, and the ratio is the median over all of them.
"""

import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from statistics import fmean, median

import torch

from catalog.store import open_store
from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.scene_styles import styled_scene
from lidarpainter_models.evaluation.flicker import FlickerFrame, FlickerTally
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.metrics.edges import edge_agreement
from lidarpainter_models.observations.image_shrinking import fit_camera
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.weather.mix import StyleMix
from tasks.opened import open_scene
from tasks.runs import open_run
from tasks.stored import load_observations, load_scene

CLEAR = "clear"
UNLIT = " without lamps of cars"
FAR_M = 5000.0
REPEATS = 2


def main(store_path: str, run_id: str, *styles: str) -> None:
    """Print a row for every style."""
    store = open_store(Path(store_path))
    run = open_run(store, run_id)
    recorded = open_scene(store, run.scene_id)
    seen = load_observations(store, run.final.observations)
    clear = replace(load_scene(store, run.final.gaussians), style=None)
    builder = ConditionBuilder(clear, seen.lidar_map, seen.views)
    first = seen.views[0]
    size = ObservationConfig(width_px=first.camera.width_px)
    views = recorded.views_of(first.key[1])
    cameras = [clear.refined_camera(view, fit_camera(view, size)) for view in views]
    moments = [(camera, view.timestamp_ns) for camera, view in zip(cameras, views, strict=True)]
    named = styles or ("foggy", "night", "rain")
    scenes = {CLEAR: clear}
    scenes |= {name: styled_scene(clear, seen, recorded, StyleMix.parse(name)) for name in named}
    scenes |= {name + UNLIT: _without_car_lamps(scenes[name]) for name in named if "night" in name}
    tally = FlickerTally(builder.boxes.tracks)
    edges: dict[str, list[float]] = {name: [] for name in named}
    for camera, now_ns in moments:
        shown = {name: scene.render(camera, now_ns) for name, scene in scenes.items()}
        images = {name: view.rgb.clamp(0, 1) for name, view in shown.items()}
        tally.add(
            FlickerFrame(
                camera=camera,
                timestamp_ns=now_ns,
                depth_m=shown[CLEAR].depth_m,
                alpha=shown[CLEAR].alpha,
                images=images,
            )
        )
        lidar_depth_m = builder.lidar_image(camera, now_ns).depth_m
        for name in named:
            found = edge_agreement(images[name], images[CLEAR], lidar_depth_m)
            edges[name] += [] if found is None else [found.f1]
    flicker = {name: asdict(found)["flicker"] for name, found in tally.scores().items()}
    sys.stdout.write(
        f"{run.scene_id}, {len(moments)} frames, {clear.num_gaussians} Gaussians, "
        f"{first.camera.width_px} x {first.camera.height_px}; clear: flicker {flicker[CLEAR]:.5f}\n"
    )
    for name in scenes.keys() - {CLEAR, *named}:
        share = flicker[name] / flicker[CLEAR]
        sys.stdout.write(f"{name}: flicker {flicker[name]:.5f}, x {share:.3f}\n")
    for name in named:
        ratios = [
            _cost(scenes[name], moment) / _cost(clear, moment)
            for _ in range(REPEATS)
            for moment in moments
        ]
        sys.stdout.write(
            f"{name}: flicker {flicker[name]:.5f}, x {flicker[name] / flicker[CLEAR]:.3f}; "
            f"edge F1 {fmean(edges[name]):.3f}; time x {median(ratios):.3f}\n"
        )


def _without_car_lamps(scene: GaussianScene) -> GaussianScene:
    """The scene with nobody's lamps on, so that no light moves in it."""
    tracks = tuple(replace(track, is_moving=False) for track in scene.actors.recorded_tracks)
    if scene.style is None:
        return scene
    place = scene.style.place
    place = replace(place, ego_lamp=place.ego_lamp + torch.tensor([0.0, 0.0, -FAR_M]))
    return replace(
        scene,
        actors=replace(scene.actors, recorded_tracks=tracks),
        style=replace(scene.style, place=place),
    )


def _cost(scene: GaussianScene, moment: tuple[Camera, int]) -> float:
    started = time.process_time()
    scene.render(*moment)
    return time.process_time() - started


if __name__ == "__main__":
    main(*sys.argv[1:])
