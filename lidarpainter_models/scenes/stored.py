"""Open a stored scene: its manifest, tables and arrays, refused unless complete.

Zarr reads a missing chunk as zeros, so completeness is checked against the manifest's list of
files and sizes when a scene is opened; every read chunk is checked by its CRC-32C. The full digest
of the content is recomputed on demand (`verify_content`). Where a scene is fetched as it is read,
each file is asked for before it is opened, and of an array only the chunks that hold the rows.
"""

import hashlib
import json
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import zarr

from lidarpainter_models.errors import DataError, SceneError
from lidarpainter_models.scenes import schema
from lidarpainter_models.scenes.validation import shown

Fetch = Callable[[Collection[str]], None]
"""Sees that files of a scene are in its folder, whole and as they were published."""

_VERIFY_ROWS = 1 << 20
_ENTRIES = {"files": dict, "arrays": dict, "tables": dict, "camera_names": list}
_ENTRIES |= {"content_digest": str, "dataset": str, "sequence": str}


def content_digest(value: object) -> str:
    """Digest of JSON-able content; Python writes floats exactly, so equal means equal."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def write_table(
    folder: Path, name: str, rows: Sequence[Mapping[str, Any]], where: str
) -> dict[str, Any]:
    """Write a table of the schema; gives its entry for the manifest. `where` names the scene.

    Raises:
        DataError: a row holds a value of another kind than the schema says.
    """
    try:
        table = pa.Table.from_pylist(list(rows), schema=schema.arrow_schema(name))
    except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
        raise DataError(
            f"{where}: the table of {name} holds a value of another kind than the format says "
            f"({shown(str(error))})"
        ) from None
    pq.write_table(table, folder / f"{name}.parquet", compression="zstd")
    # the digest is of what is stored, which an int among floats is not
    return {"num_rows": len(table), "sha256": content_digest(table.to_pylist())}


def stored_digest(path: Path) -> str | None:
    """The content digest of the complete scene at a path, or None where there is none."""
    try:
        return read_manifest(path)["content_digest"]
    except SceneError:
        return None


def read_manifest(path: Path, *, is_all_here: bool = True) -> dict[str, Any]:
    """The manifest of a scene, after checking that every file it lists is there.

    Unless all is here, files are fetched later, and not looked for.

    Raises:
        SceneError: there is no scene, it is incomplete, or another version wrote it.
    """
    file = path / schema.MANIFEST_NAME
    try:
        manifest = json.loads(file.read_text("utf-8"))
    except FileNotFoundError:
        raise SceneError(f"{path}: no scene here (no {schema.MANIFEST_NAME})") from None
    except (OSError, ValueError) as error:
        raise SceneError(f"{file}: cannot be read ({shown(str(error))})") from None
    if not isinstance(manifest, dict) or manifest.get("is_complete") is not True:
        raise SceneError(f"{path}: the scene is not complete; ingest it again")
    if manifest.get("schema_version") not in schema.READABLE_VERSIONS:
        raise SceneError(
            f"{path}: the scene has schema version {manifest.get('schema_version')}, "
            f"expected {schema.SCHEMA_VERSION} or an older one; ingest it again"
        )
    for name, kind in _ENTRIES.items():
        if not isinstance(manifest.get(name), kind):
            raise SceneError(f"{file}: {name} is no {kind.__name__}; the scene is damaged")
    for name, num_bytes in manifest["files"].items() if is_all_here else ():
        _require_file(path / name, num_bytes)
    return manifest


def _require_file(file: Path, num_bytes: int) -> None:
    try:
        found = file.stat().st_size
    except FileNotFoundError:
        raise SceneError(f"{file}: missing; the scene is damaged, ingest it again") from None
    if found != num_bytes:
        raise SceneError(
            f"{file}: {found} bytes, expected {num_bytes}; the scene is damaged, ingest it again"
        )


class StoredScene:
    """The files of one scene, read lazily."""

    def __init__(self, path: Path, fetch: Fetch | None = None) -> None:
        self.path = Path(path)
        self._fetch = fetch or (lambda _names: None)
        self._fetch([schema.MANIFEST_NAME])
        self.manifest = read_manifest(self.path, is_all_here=fetch is None)
        self._arrays: dict[str, zarr.Array] = {}

    def table(self, name: str) -> pa.Table:
        """One of the tables of the schema, whole, with the columns of today's schema."""
        return schema.as_current(self._stored_table(name), name)

    def _stored_table(self, name: str) -> pa.Table:
        """A table as it was written; its columns are those of the version that wrote it."""
        file = self.path / f"{name}.parquet"
        self._fetch([file.name])
        try:
            table = pq.read_table(file)
        except (OSError, pa.ArrowException) as error:
            raise SceneError(f"{file}: cannot be read ({shown(str(error))})") from None
        expected = schema.arrow_schema(name, self.manifest["schema_version"])
        if not table.schema.equals(expected):
            raise SceneError(
                f"{file}: columns {', '.join(table.schema.names)}, "
                f"expected {', '.join(expected.names)} with the types of the schema"
            )
        return table

    def has_array(self, name: str) -> bool:
        """Whether the scene holds an optional array."""
        return name in self.manifest["arrays"]

    def read_rows(self, name: str, offset: int, num_rows: int) -> np.ndarray:
        """Rows of an array as a new numpy array.

        Raises:
            SceneError: the rows do not exist or a chunk is damaged.
        """
        total = self.manifest["arrays"][name]["shape"][0]
        if not 0 <= offset <= offset + num_rows <= total:
            raise SceneError(
                f"{self.path}: rows {offset} to {offset + num_rows} of {name}, which has {total}"
            )
        try:
            array = self._array(name)
            self._fetch(self._chunks(name, offset, num_rows, array.chunks[0]))
            rows = array[offset : offset + num_rows]
        except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
            raise SceneError(
                f"{self.path}: array {name} cannot be read ({shown(str(error))}); "
                "ingest the scene again"
            ) from None
        return np.asarray(rows)

    def _array(self, name: str) -> zarr.Array:
        """An array, opened once: that takes as long as reading a sweep."""
        if name not in self._arrays:
            self._fetch([f"{schema.ARRAYS_NAME}/{name}/zarr.json"])
            self._arrays[name] = zarr.open_array(
                self.path / schema.ARRAYS_NAME / name,
                mode="r",
                zarr_format=3,  # version 2 has codecs that unpickle
            )
        return self._arrays[name]

    def _chunks(self, name: str, offset: int, num_rows: int, chunk_rows: int) -> list[str]:
        """Files of an array that hold some of its rows."""
        begin = f"{schema.ARRAYS_NAME}/{name}/c/"
        wanted = range(offset // chunk_rows, -(-(offset + num_rows) // chunk_rows))
        files = (file for file in self.manifest["files"] if file.startswith(begin))
        return [file for file in files if int(file.removeprefix(begin).split("/")[0]) in wanted]

    def verify_content(self) -> None:
        """Read everything and compare it with the digests in the manifest.

        Raises:
            SceneError: a table or array is not what was written.
        """
        for name, entry in self.manifest["tables"].items():
            if content_digest(self._stored_table(name).to_pylist()) != entry["sha256"]:
                raise SceneError(f"{self.path}: table {name} is not what was written")
        for name, entry in self.manifest["arrays"].items():
            digest = hashlib.sha256()
            total = entry["shape"][0]
            for offset in range(0, total, _VERIFY_ROWS):
                rows = self.read_rows(name, offset, min(_VERIFY_ROWS, total - offset))
                digest.update(np.ascontiguousarray(rows).tobytes())
            if digest.hexdigest() != entry["sha256"]:
                raise SceneError(f"{self.path}: array {name} is not what was written")
