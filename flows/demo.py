"""The built-in synthetic street through the whole pipeline."""

from pathlib import Path
from typing import Any

from prefect import flow

from catalog.store import open_store
from flows.parameters import ReconstructParameters
from flows.presets import preview
from flows.reconstruct import reconstruct
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS, SyntheticStreetConfig
from tasks.painter.harvest import keep_street
from tasks.specs import street_id

DEMO_SEED = 1
"""Kept apart from the seeds that painters are trained and tested on."""
DEMO_CAMERAS = DEFAULT_CAMERAS[:1]
"""The front camera alone: minutes on a CPU."""


def demo_street(seed: int = DEMO_SEED) -> SyntheticStreetConfig:
    """The street of the demo, or another one of its kind."""
    return SyntheticStreetConfig(seed=seed, width_px=640, height_px=360, cameras=DEMO_CAMERAS)


@flow(name="demo")
def demo(
    street: SyntheticStreetConfig, parameters: ReconstructParameters, store_path: Path
) -> dict[str, Any]:
    """Make the street, then reconstruct it."""
    keep_street(store_path, street)
    return reconstruct.fn(parameters, store_path)  # its tasks, without the cost of a subflow


@flow(name="demo-scene")
def demo_scene(store: str | None = None) -> dict[str, Any]:
    """Run the demo as a worker is asked to, in the worker's store."""
    return demo.fn(demo_street(), preview(street_id(DEMO_SEED)), open_store(store).root)
