"""A seeded procedural street with exact images, depth and LiDAR from any pose."""

from lidarpainter_models.synthetic.config import (
    DEFAULT_CAMERAS,
    RigCamera,
    RigLidar,
    SyntheticStreetConfig,
)
from lidarpainter_models.synthetic.sequence import record_street, street_name, write_street
from lidarpainter_models.synthetic.street import SyntheticStreet
from lidarpainter_models.synthetic.truth import LensState, TrueImage

__all__ = [
    "DEFAULT_CAMERAS",
    "LensState",
    "RigCamera",
    "RigLidar",
    "SyntheticStreet",
    "SyntheticStreetConfig",
    "TrueImage",
    "record_street",
    "street_name",
    "write_street",
]
