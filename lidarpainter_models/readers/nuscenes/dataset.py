"""The tables of a nuScenes download: versions, scenes, samples; each table is read once a process.

Below the root lie the versions (`v1.0-trainval`, `v1.0-test`, `v1.0-mini`), each a folder of JSON
tables, beside `samples/` and `sweeps/`. A scene of several versions (mini is a part of trainval) is
taken from the first of them in the order above; other versions follow by name.
"""

import stat
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.nuscenes.rows import TableRow, shown
from lidarpainter_models.readers.nuscenes.tables import NuscenesTable
from lidarpainter_models.scenes.validation import require_name

_FIRST_VERSIONS = ("v1.0-trainval", "v1.0-test", "v1.0-mini")
_KEYS = {
    "scene": "name",
    "sample": "scene_token",
    "sample_data": "sample_token",
    "sample_annotation": "sample_token",
    "ego_pose": "token",
    "calibrated_sensor": "token",
    "sensor": "token",
    "instance": "token",
    "category": "token",
    "log": "token",
}
"""The tables that are read and the column each is looked up by."""


class NuscenesTables:
    """The tables of one version, each read when first asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __getitem__(self, name: str) -> NuscenesTable:
        path = self.folder / f"{name}.json"
        try:
            status = path.stat()
        except OSError:
            raise DataError(f"{path}: the table is missing") from None
        if not stat.S_ISREG(status.st_mode):  # a pipe would be waited for without end
            raise DataError(f"{path}: not a file")
        stamp = (status.st_size, status.st_mtime_ns, status.st_ino)
        return _read_table(path, _KEYS[name], stamp)

    def digests(self) -> dict[str, str]:
        """SHA-256 of every table."""
        return {name: self[name].sha256 for name in _KEYS}


@lru_cache(maxsize=3 * len(_KEYS))
def _read_table(path: Path, key: str, stamp: tuple[int, ...]) -> NuscenesTable:  # noqa: ARG001
    """One table, kept for the next sequence; `stamp` makes a changed file be read anew."""
    return NuscenesTable(path, key)


def open_versions(root: Path) -> list[NuscenesTables]:
    """The versions below a root, the fullest first."""
    folders = [file.parent for file in Path(root).glob("v1.0-*/scene.json")]
    order = {name: position for position, name in enumerate(_FIRST_VERSIONS)}
    folders.sort(key=lambda folder: (order.get(folder.name, len(order)), folder.name))
    return [NuscenesTables(folder) for folder in folders]


def find_scene(root: Path, name: str) -> tuple[NuscenesTables, TableRow]:
    """The row of a scene and the version it is in.

    Raises:
        DataError: no version has that scene, or one has it twice.
    """
    versions = open_versions(root)
    if not versions:
        raise DataError(f"{root}: no folder v1.0-* with a scene.json, expected nuScenes' tables")
    for tables in versions:
        if tables["scene"].rows_with(name):
            return tables, tables["scene"].row(name, str(root))
    folders = ", ".join(tables.folder.name for tables in versions)
    raise DataError(f"{root}: no scene {shown(name)} in {folders}")


def read_global_frame(tables: NuscenesTables, scene: TableRow) -> str:
    """Name of the frame that the poses of a scene are in: that of the map of its location.

    Raises:
        DataError: the log of the scene is missing, or its location makes no name.
    """
    log = tables["log"].row(scene.text("log_token"), scene.where)
    return require_name(f"nuscenes-{log.text('location')}", f"{log.where}: location")


def read_samples(tables: NuscenesTables, scene: TableRow) -> list[str]:
    """The tokens of a scene's samples, which are its key frames, by time.

    Raises:
        DataError: there are not as many as the scene states, or two have one token or time.
    """
    rows = sorted(tables["sample"].rows_with(scene.text("token")), key=TableRow.timestamp_ns)
    stated = scene.count("nbr_samples")
    if len(rows) != stated or not rows:
        raise DataError(
            f"{scene.where}: states {stated} samples, {tables['sample'].path} has {len(rows)}"
        )
    for before, after in pairwise(rows):
        if before.timestamp_ns() == after.timestamp_ns():
            raise DataError(f"{after.where}: another sample of the scene has the same time")
    samples = [row.text("token") for row in rows]
    if len(set(samples)) != len(samples):
        raise DataError(f"{scene.where}: two samples of the scene have the same token")
    return samples
