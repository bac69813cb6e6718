"""A seeded procedural street with exact pictures, depth and LiDAR from any pose."""

from lidarpainter_models.scenes.synthetic.config import (
    DEFAULT_CAMERAS,
    RigCamera,
    RigLidar,
    SyntheticStreetConfig,
)
from lidarpainter_models.scenes.synthetic.sequence import record_street, street_name, write_street
from lidarpainter_models.scenes.synthetic.street import SyntheticStreet, TruePicture

__all__ = [
    "DEFAULT_CAMERAS",
    "RigCamera",
    "RigLidar",
    "SyntheticStreet",
    "SyntheticStreetConfig",
    "TruePicture",
    "record_street",
    "street_name",
    "write_street",
]
