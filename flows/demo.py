"""The built-in synthetic street through the whole pipeline."""

from pathlib import Path
from typing import Any

from jaxtyping import Float
from prefect import flow
from torch import Tensor

from catalog.store import open_store
from flows.parameters import ReconstructParameters
from flows.presets import brief
from flows.reconstruct import reconstruct
from lidarpainter_models.export.images import write_png
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS, SyntheticStreetConfig
from lidarpainter_models.synthetic.street import SyntheticStreet
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
    street: SyntheticStreetConfig,
    parameters: ReconstructParameters,
    store_path: Path,
    first_image: Path | None = None,
) -> dict[str, Any]:
    """Make the street, then reconstruct it.

    `first_image` shows what the first camera sees at first, long before the rest is done.
    """
    if first_image is not None:
        write_png(_first_view(street), first_image)
    keep_street(store_path, street)
    return reconstruct(parameters, store_path)  # its tasks, without the cost of a subflow


def _first_view(config: SyntheticStreetConfig) -> Float[Tensor, "height width 3"]:
    street = SyntheticStreet(config)
    first_ns = street.timestamps_ns[0]
    return street.render(street.camera(config.cameras[0].name, first_ns), first_ns).rgb


@flow(name="demo-scene")
def demo_scene(store: str | None = None) -> dict[str, Any]:
    """Run the demo as a worker is asked to, in the worker's store."""
    return demo.fn(demo_street(), brief(street_id(DEMO_SEED)), open_store(store).address)
