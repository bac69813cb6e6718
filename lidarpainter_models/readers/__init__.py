"""Readers of datasets as downloaded; each ends its dataset's oddities and writes a scene."""

from lidarpainter_models.readers.datasets import (
    ingest_scene,
    known_datasets,
    list_sequences,
    open_log,
    scene_id_of,
)

__all__ = ["ingest_scene", "known_datasets", "list_sequences", "open_log", "scene_id_of"]
