"""Draw the streets of the table of logs: one clear street, and one at dusk.

    python scripts/street_logs.py STORE

Every one has a seed of its own, so that no street of a stress sweep or a calibration is among them.
What is there as asked for stays.
"""

import sys
from dataclasses import replace
from pathlib import Path

from catalog.store import open_store
from lidarpainter_models.synthetic import SyntheticStreetConfig
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS
from tasks.ingest.ingest import has_street, ingest_street

CLEAR = SyntheticStreetConfig(
    seed=401, num_frames=20, width_px=480, height_px=270, cameras=DEFAULT_CAMERAS
)
STREETS = {
    "clear": CLEAR,
    "dusk": replace(
        CLEAR,
        seed=402,
        sensor_noise=0.02,
        cameras=tuple(replace(one, gain=0.25 * one.gain) for one in DEFAULT_CAMERAS),
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
