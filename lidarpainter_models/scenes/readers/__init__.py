"""Readers of datasets as downloaded; each ends its dataset's oddities and writes a scene."""

from collections.abc import Callable
from pathlib import Path

from lidarpainter_models.errors import DataError
from lidarpainter_models.scenes.readers.canonical.reader import (
    list_canonical_scenes,
    read_canonical,
)
from lidarpainter_models.scenes.readers.nuscenes.reader import list_nuscenes_scenes, read_nuscenes
from lidarpainter_models.scenes.readers.pandaset.reader import (
    list_pandaset_sequences,
    read_pandaset,
)
from lidarpainter_models.scenes.readers.waymo.reader import list_waymo_segments, read_waymo

Progress = Callable[[int, int], None]
"""Told frames done and frames in all."""

_READERS = {
    "pandaset": (list_pandaset_sequences, read_pandaset),
    "nuscenes": (list_nuscenes_scenes, read_nuscenes),
    "waymo": (list_waymo_segments, read_waymo),
    "canonical": (list_canonical_scenes, read_canonical),
}


def known_datasets() -> tuple[str, ...]:
    """Names of the datasets that can be read."""
    return tuple(_READERS)


def list_sequences(dataset: str, root: Path) -> tuple[str, ...]:
    """The sequences found below a dataset's root.

    Raises:
        DataError: the dataset is not known, or the root is no folder or holds no sequence.
    """
    list_found, _read = _reader(dataset)
    if not Path(root).is_dir():
        raise DataError(f"{root}: no such folder, expected the root of {dataset}")
    found = list_found(Path(root))
    if not found:
        raise DataError(f"{root}: no {dataset} sequence found")
    return found


def ingest_scene(
    dataset: str,
    root: Path,
    sequence: str,
    store: Path,
    *,
    frames: slice | None = None,
    cameras: tuple[str, ...] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Read one sequence of a dataset and write it into the store; gives the scene's path.

    Raises:
        DataError: the dataset is not known, or the log is missing something, damaged or senseless.
        StorageError: the store cannot be written.
    """
    _list_found, read = _reader(dataset)
    return read(
        Path(root), sequence, Path(store), frames=frames, cameras=cameras, progress=progress
    )


def _reader(dataset: str) -> tuple[Callable[..., tuple[str, ...]], Callable[..., Path]]:
    try:
        return _READERS[dataset]
    except KeyError:
        raise DataError(
            f"dataset {dataset!r} is not known, expected one of {', '.join(_READERS)}"
        ) from None
