"""The built-in synthetic street through the whole pipeline."""

from pathlib import Path
from typing import Any

from prefect import flow

from flows.parameters import ReconstructParameters
from flows.presets import preview
from flows.reconstruct import reconstruct
from lidarpainter_models.scenes.synthetic.config import SyntheticStreetConfig
from tasks.ingest import ingest_street

DEMO_SEED = 1
"""Kept apart from the seeds that painters are trained and tested on."""


def demo_street() -> SyntheticStreetConfig:
    """The street of the demo."""
    return SyntheticStreetConfig(seed=DEMO_SEED)


def demo_parameters() -> ReconstructParameters:
    """The preview preset on that street."""
    return preview(f"synthetic/street-{DEMO_SEED:04d}")


@flow(name="demo")
def demo(
    street: SyntheticStreetConfig, parameters: ReconstructParameters, store_path: Path
) -> dict[str, Any]:
    """Make the street, then reconstruct it."""
    ingest_street(store_path, street)
    return reconstruct.fn(parameters, store_path)  # its tasks, without the cost of a subflow
