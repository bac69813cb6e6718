"""A synthetic street that is driven twice: along it, and back between the oncoming cars.

    python scripts/returning_street.py STORE SEED...

Records both ways as the front camera sees them (12 frames, 0.25 s apart, 400 px), the way back at
0.7 of the exposure. What is there as asked for stays. Seed 421 is the way along, seed 1421 the way
back through the same street at the same times: the same cars, parked and moving, from their other
ends. An actor has one id in both that no other street gives, as cars of real data sets have.
"""

import argparse
import sys
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from catalog.store import open_store
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS, SyntheticStreetConfig
from lidarpainter_models.synthetic.plan.ego_motion import EgoMotion
from lidarpainter_models.synthetic.sequence import record_street
from lidarpainter_models.synthetic.street import SyntheticStreet
from lidarpainter_models.synthetic.truth import ActorState
from tasks.ingest.ingest import has_street, record_scene, writing
from tasks.specs import street_id

BACK = 1000
"""What the seed of the way back is more."""
BACK_GAIN = 0.7
"""Exposure of the way back."""
BEGINS_M = 60.0
"""About where along the street the way back begins."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ReturningEgo(EgoMotion):
    """The recording car on its way back, level on the street."""

    start_s_m: float
    d_m: float

    def world_from_ego(self, time_s: np.ndarray) -> np.ndarray:
        """(n, 4, 4)."""
        return self.line.poses(self.start_s_m + self.travelled_m(time_s), self.d_m, np.pi)


class ReturningStreet(SyntheticStreet):
    """A street whose seed says which way it is driven."""

    def __init__(self, config: SyntheticStreetConfig) -> None:
        super().__init__(config)
        if config.seed >= BACK:
            self._city = replace(self._city, ego=self._returning())

    def _world(self) -> dict[str, Any]:
        return {**super()._world(), "seed": self.config.seed % BACK}

    def _returning(self) -> ReturningEgo:
        """Midway between two oncoming cars, as fast as they are."""
        plan = self._city.plan
        lane_m = plan.oncoming_d_m[0]
        cars = [car for car in self._city.actors if car.pace and abs(car.d_m - lane_m) < 0.5]
        places = sorted(car.start_s_m for car in cars if car.category != "pedestrian")
        gaps = [(one + other) / 2 for one, other in pairwise(places)]
        pace = next(car.pace for car in cars if car.pace)
        start_m = min(gaps, key=lambda middle: abs(middle - BEGINS_M))
        known = {field.name: getattr(self._city.ego, field.name) for field in fields(EgoMotion)}
        return ReturningEgo(**{**known, "pace": pace}, start_s_m=start_m, d_m=lane_m)

    def actors(self, timestamp_ns: int) -> list[ActorState]:
        """Every actor's box at a time, under an id that only this street gives."""
        street = f"street-{self.config.seed % BACK:04d}"
        found = super().actors(timestamp_ns)
        return [replace(one, actor_id=f"{street}-{one.actor_id}") for one in found]


def ways(seed: int) -> list[SyntheticStreetConfig]:
    """Both ways through a street, along it first."""
    camera = DEFAULT_CAMERAS[0]
    return [
        SyntheticStreetConfig(
            seed=seed + more,
            num_frames=12,
            frame_interval_s=0.25,
            width_px=400,
            height_px=225,
            cameras=(replace(camera, gain=gain),),
        )
        for more, gain in ((0, 1.0), (BACK, BACK_GAIN))
    ]


def main() -> None:
    """Record what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store", type=Path)
    parser.add_argument("seeds", nargs="+", type=int, help="each below 1000")
    asked = parser.parse_args()
    store = open_store(asked.store)
    store.make()
    for config in (config for seed in asked.seeds for config in ways(seed)):
        if not has_street(store, config):
            with writing(store, street_id(config.seed)):
                path = record_street(ReturningStreet(config), store.root)
            sys.stdout.write(f"{record_scene(store, path)['scene_id']}\n")


if __name__ == "__main__":
    main()
