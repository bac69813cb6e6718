"""Draw the streets of the table of logs: one clear street, others recorded worse or by other rigs.

    python scripts/street_logs.py STORE

Every one has a seed of its own, so that no street of a stress sweep or a calibration is among them.
What is there as asked for stays.
"""

import sys
from dataclasses import replace
from pathlib import Path

from catalog.store import open_store
from lidarpainter_models.synthetic import RigCamera, RigLidar, SyntheticStreetConfig
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS
from tasks.ingest.ingest import has_street, ingest_street

FRONT = DEFAULT_CAMERAS[0]
CLEAR = SyntheticStreetConfig(
    seed=401, num_frames=20, width_px=480, height_px=270, cameras=DEFAULT_CAMERAS
)
ROUND = tuple(
    RigCamera(
        name=f"camera_{number}",
        focal_per_width=0.6,
        yaw_rad=0.785398 * number,
        forward_m=0.3,
        gain=1.0 - 0.03 * number,
    )
    for number in range(8)
)
"""Eight cameras all around, each a little darker than the one before."""
STREETS = {
    "clear": CLEAR,
    "dusk": replace(
        CLEAR,
        seed=402,
        sensor_noise=0.02,
        cameras=tuple(replace(one, gain=0.25 * one.gain) for one in DEFAULT_CAMERAS),
    ),
    "rain": replace(
        CLEAR, seed=403, sensor_noise=0.012, lidar=RigLidar(dropout=0.35, max_range_m=45.0)
    ),
    "fast": replace(
        CLEAR,
        seed=404,
        speed_mps=(22.0, 22.0),
        cameras=tuple(replace(one, readout_s=0.03) for one in DEFAULT_CAMERAS),
        pose_noise_m=0.02,
        pose_noise_rad=0.001,
    ),
    "16 beams": replace(CLEAR, seed=405, lidar=RigLidar(beams=16)),
    "eight cameras": replace(CLEAR, seed=406, width_px=320, height_px=180, cameras=ROUND),
    "long lens": replace(
        CLEAR, seed=407, cameras=(replace(FRONT, name="front_camera", focal_per_width=2.2),)
    ),
}
"""By what is said of them in the table."""


def main(folder: str) -> None:
    """Draw what is missing."""
    store = open_store(Path(folder))
    store.make()
    for words, config in STREETS.items():
        if not has_street(store, config):
            sys.stdout.write(f"{words}: {ingest_street.fn(store.address, config)['scene_id']}\n")


if __name__ == "__main__":
    main(sys.argv[1])
