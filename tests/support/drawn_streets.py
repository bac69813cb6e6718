"""Small synthetic streets, each drawn once for all workers of pytest: drawing one takes seconds.

A street is all in the settings of its world, so what one worker has drawn the others read from a
file. `conftest` makes their folder and puts `kept_city` where streets are drawn.
"""

import fcntl
import hashlib
import json
import os
import pickle
from pathlib import Path
from typing import Any

from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import RigLidar, SyntheticStreetConfig, write_street
from lidarpainter_models.synthetic.world.city import build_city


def recorded_street(store, cameras, *, beams=32, **settings):
    """A small street as these cameras and one LiDAR record it."""
    small: dict[str, Any] = {
        "seed": 5,
        "num_frames": 3,
        "width_px": 96,
        "height_px": 54,
        "samples_per_axis": 1,
        "lidar": RigLidar(beams=beams, columns=360),
    }
    config = SyntheticStreetConfig(cameras=cameras, **(small | settings))
    return DrivingScene.open(write_street(config, store))


def kept_city(**world):
    """`build_city`, or what it gave in this test run."""
    name = hashlib.sha256(json.dumps(world, sort_keys=True).encode()).hexdigest()[:16]
    path = Path(os.environ["LIDARPAINTER_DRAWN_STREETS"]) / f"{name}.pickle"
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if path.exists():
            return pickle.loads(path.read_bytes())  # noqa: S301 - our own file
        city = build_city(**world)
        begun = path.with_suffix(".begun")
        begun.write_bytes(pickle.dumps(city, protocol=pickle.HIGHEST_PROTOCOL))
        begun.rename(path)
        return city
