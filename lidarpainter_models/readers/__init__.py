"""Readers of datasets as downloaded; each ends its dataset's oddities and writes a scene.

Here is which datasets there are, what they hold, and how one is ingested.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from lidarpainter_models.errors import ConfigError, DataError

if TYPE_CHECKING:  # which datasets there are is known without them: a mistyped one costs nothing
    from lidarpainter_models.readers.source_logs.log import Progress, SourceLog

CANONICAL = "canonical"
"""In place of a dataset: scenes that were written elsewhere, whatever dataset they are of."""


class Reader(NamedTuple):
    """The functions of a dataset's reader."""

    list_sequences: Callable[[Path], tuple[str, ...]]
    """The sequences below a root, by name."""
    open_log: "Callable[..., SourceLog]"
    """Takes the root, the sequence, and which frames and cameras to take, all of them if None; of a
    dataset whose files say no rig that too, None for the one that is proposed."""
    is_file: bool = False
    """Whether a root may be a file, and a rig belongs to it."""


def _pandaset() -> Reader:
    from lidarpainter_models.readers.pandaset.reader import PandasetLog, list_pandaset_sequences

    return Reader(list_pandaset_sequences, PandasetLog)


def _nuscenes() -> Reader:
    from lidarpainter_models.readers.nuscenes.reader import NuscenesLog, list_nuscenes_scenes

    return Reader(list_nuscenes_scenes, NuscenesLog)


def _waymo() -> Reader:
    from lidarpainter_models.readers.waymo.reader import WaymoLog, list_waymo_segments

    return Reader(list_waymo_segments, WaymoLog)


def _av2() -> Reader:
    from lidarpainter_models.readers.av2.reader import Av2Log, list_av2_logs

    return Reader(list_av2_logs, Av2Log)


def _kitti() -> Reader:
    from lidarpainter_models.readers.kitti.drives import list_kitti_drives
    from lidarpainter_models.readers.kitti.reader import KittiLog

    return Reader(list_kitti_drives, KittiLog)


def _ncore() -> Reader:
    from lidarpainter_models.readers.ncore.reader import NcoreLog
    from lidarpainter_models.readers.ncore.sequence import list_ncore_sequences

    return Reader(list_ncore_sequences, NcoreLog)


def _mcap() -> Reader:
    from lidarpainter_models.readers.bags.chunks import list_bags
    from lidarpainter_models.readers.bags.reader import BagLog

    return Reader(list_bags, BagLog, is_file=True)


def _canonical() -> Reader:
    from lidarpainter_models.readers.canonical.reader import ForeignScene, list_canonical_scenes

    return Reader(list_canonical_scenes, ForeignScene)


_READERS: dict[str, Callable[[], Reader]] = {
    "pandaset": _pandaset,
    "nuscenes": _nuscenes,
    "waymo": _waymo,
    "av2": _av2,
    "kitti": _kitti,
    "ncore": _ncore,
    "mcap": _mcap,
    CANONICAL: _canonical,
}


def known_datasets() -> tuple[str, ...]:
    """Names of the datasets that can be read."""
    return tuple(_READERS)


def list_sequences(dataset: str, root: Path) -> tuple[str, ...]:
    """The sequences found below a dataset's root.

    Raises:
        DataError: the dataset is not known, or the root is no folder or holds no sequence.
    """
    reader = _reader(dataset)
    if not Path(root).is_dir() and not (reader.is_file and Path(root).is_file()):
        raise DataError(f"{root}: no such folder, expected the root of {dataset}")
    found = reader.list_sequences(Path(root))
    if not found:
        raise DataError(f"{root}: no {dataset} sequence found")
    return found


def scene_id_of(dataset: str, root: Path, sequence: str) -> str:
    """What a sequence will be called in a store: `dataset/sequence`, or as its own manifest says.

    Raises:
        DataError: it is a scene from elsewhere whose manifest says no names.
    """
    if dataset != CANONICAL:
        return f"{dataset}/{sequence}"
    from lidarpainter_models.readers.canonical.reader import own_scene_id

    return own_scene_id(root, sequence)


def ingest_scene(
    dataset: str,
    root: Path,
    sequence: str,
    store: Path,
    *,
    frames: slice | None = None,
    cameras: tuple[str, ...] | None = None,
    progress: "Progress | None" = None,
) -> Path:
    """Read one sequence of a dataset and write it into the store; gives the scene's path.

    Raises:
        DataError: the dataset is not known, or the log is missing something, damaged or senseless.
        WriteError: the store cannot be written.
    """
    from lidarpainter_models.readers.source_logs.log import write_log

    log = open_log(dataset, root, sequence, frames=frames, cameras=cameras)
    return write_log(log, Path(store), progress=progress)


def open_log(
    dataset: str,
    root: Path,
    sequence: str,
    *,
    frames: slice | None = None,
    cameras: tuple[str, ...] | None = None,
    rig: Path | None = None,
) -> "SourceLog":
    """Open one sequence of a dataset.

    The root is the folder as downloaded. Frames are taken by position, cameras by name; None takes
    all. A rig says which topics of a bag are which sensor (bags/rig.py).

    Raises:
        DataError: the dataset is not known, or the log is missing something, damaged or senseless.
        ConfigError: the rig cannot be read, or the dataset takes none.
    """
    from lidarpainter_models.scenes.validation import require_name

    reader = _reader(dataset)
    require_name(sequence, "sequence")
    if reader.is_file:
        return reader.open_log(Path(root), sequence, frames, cameras, rig)
    if rig is not None:
        raise ConfigError(f"{rig}: a map is for mcap, the files of {dataset} say their own rig")
    return reader.open_log(Path(root), sequence, frames, cameras)


def _reader(dataset: str) -> Reader:
    if dataset not in _READERS:
        raise DataError(f"dataset {dataset!r} is not known, expected one of {', '.join(_READERS)}")
    return _READERS[dataset]()
