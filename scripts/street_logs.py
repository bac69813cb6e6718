"""Draw the streets of the table of logs: four weathers, three rigs.

    python scripts/street_logs.py STORE

Every one has a seed of its own, so that no street of a stress sweep or a calibration is among them.
What is there as asked for stays.
"""

import argparse
import sys
from dataclasses import replace
from math import radians
from pathlib import Path

from fisheye_street import FisheyeStreet
from weather_streets import FoggyStreet, RainyStreet

from catalog.store import open_store
from lidarpainter_models.synthetic import SyntheticStreet, SyntheticStreetConfig
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS, RigCamera, RigLidar
from lidarpainter_models.synthetic.sequence import record_street
from tasks.ingest.ingest import has_street, record_scene, writing
from tasks.specs import street_id

CLEAR = SyntheticStreetConfig(
    seed=401, num_frames=20, width_px=480, height_px=270, cameras=DEFAULT_CAMERAS
)
LONG_LENS = RigCamera(name="front_camera", focal_per_width=1.866)
"""30 degrees across."""


def _around(name: str, yaw_deg: float, forward_m: float, left_m: float) -> RigCamera:
    return RigCamera(
        name=name,
        focal_per_width=0.714,
        yaw_rad=radians(yaw_deg),
        forward_m=forward_m,
        left_m=left_m,
    )


AROUND = (
    _around("front_camera", 0, 0.4, 0.0),
    _around("front_left_camera", 55, 0.2, 0.6),
    _around("front_right_camera", -55, 0.2, -0.6),
    _around("left_fisheye", 90, 0.8, 0.9),
    _around("right_fisheye", -90, 0.8, -0.9),
    _around("back_left_camera", 125, -0.4, 0.6),
    _around("back_right_camera", -125, -0.4, -0.6),
    _around("back_camera", 180, -0.8, 0.0),
)
"""70 degrees across each, but for the fisheyes, whose lens is that of `FisheyeStreet`."""
STREETS: dict[str, tuple[type[SyntheticStreet], SyntheticStreetConfig]] = {
    "clear": (SyntheticStreet, CLEAR),
    "dusk": (
        SyntheticStreet,
        replace(
            CLEAR,
            seed=402,
            sensor_noise=0.02,
            cameras=tuple(replace(one, gain=0.25 * one.gain) for one in DEFAULT_CAMERAS),
        ),
    ),
    "fog": (FoggyStreet, replace(CLEAR, seed=403)),
    "rain": (RainyStreet, replace(CLEAR, seed=404)),
    "16 beams": (SyntheticStreet, replace(CLEAR, seed=405, lidar=RigLidar(beams=16))),
    "eight cameras": (
        FisheyeStreet,
        replace(CLEAR, seed=406, width_px=320, height_px=180, cameras=AROUND),
    ),
    "long lens": (SyntheticStreet, replace(CLEAR, seed=407, cameras=(LONG_LENS,))),
}
"""By what is said of them in the table."""


def main(folder: str) -> None:
    """Draw what is missing."""
    store = open_store(Path(folder))
    store.make()
    for words, (kind, config) in STREETS.items():
        if has_street(store, config):
            continue
        with writing(store, street_id(config.seed)):
            path = record_street(kind(config), store.root)
        sys.stdout.write(f"{words}: {record_scene(store, path)['scene_id']}\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store", help="where the streets are written")
    main(parser.parse_args().store)
