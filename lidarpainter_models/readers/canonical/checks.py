"""Refuse a scene folder from elsewhere unless every file of it is what the format says.

A manifest, Parquet files and Zarr metadata steer what a library allocates, which files it opens and
which codecs it runs. So they are read here first, with bounds, and must say exactly what
docs/canonical-format.md says before any library opens them.
"""

import json
import math
import re
import stat
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.source_logs.parquet_pages import unpacked_bytes
from lidarpainter_models.scenes import schema
from lidarpainter_models.scenes.validation import require_classes, require_name, shown

MAX_MANIFEST_BYTES = 16_000_000
MAX_FILES = 100_000
MAX_TABLE_ROWS = 200_000
"""Boxes of 200 frames have at most a few ten thousand rows."""
MAX_LIST_LENGTH = 16
MAX_TABLE_BYTES = 256 << 20
"""When unpacked; 200,000 boxes take 50 MB."""
MAX_TEXT_BYTES = 64 << 20
"""Of one column, in all rows; 200,000 names of full length take 26 MB."""
_CHUNK_OVERHEAD = 1024
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_DIGEST = re.compile(r"[0-9a-f]{64}")
_NAME_PART = re.compile(r"[A-Za-z0-9._-]+")


def read_foreign_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a scene folder, after checking it and everything it lists.

    Raises:
        DataError: something is missing, damaged, or not what the format says.
    """
    file = folder / schema.MANIFEST_NAME
    manifest = read_small_json(file)
    if manifest.get("is_complete") is not True:
        raise DataError(f"{file}: is_complete is not true: the scene was not written to its end")
    version = manifest.get("schema_version")
    if not isinstance(version, int) or version not in schema.READABLE_VERSIONS:
        raise DataError(
            f"{file}: schema_version is {version!r:.40}, expected {schema.SCHEMA_VERSION} or an "
            "older one"
        )
    _require_texts(manifest, str(file))
    _require_origins(manifest, str(file))
    pose = manifest.get("global_from_world")
    if not (isinstance(pose, list) and len(pose) == 16 and all(map(_is_number, pose))):
        raise DataError(f"{file}: global_from_world is no list of 16 numbers")
    _require_files(manifest.get("files"), folder)
    _require_entries(manifest, str(file))
    for name in schema.TABLES:
        _require_table(folder / f"{name}.parquet", version)
    _require_group(folder / schema.ARRAYS_NAME)
    for name, entry in manifest["arrays"].items():
        _require_array(folder / schema.ARRAYS_NAME / name, schema.ARRAYS[name], entry["shape"][0])
    return manifest


def read_small_json(file: Path) -> dict[str, Any]:
    """A JSON object from a regular file of at most `MAX_MANIFEST_BYTES`."""
    try:
        status = file.lstat()
        if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_MANIFEST_BYTES:
            raise DataError(f"{file}: expected a file of at most {MAX_MANIFEST_BYTES} bytes")
        value = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, DataError):
            raise
        reason = getattr(error, "strerror", None) or f"no JSON: {shown(str(error))}"
        raise DataError(f"{file}: cannot be read ({reason})") from None
    if not isinstance(value, dict):
        raise DataError(f"{file}: holds no JSON object")
    return value


def _require_texts(manifest: dict[str, Any], where: str) -> None:
    names = ("dataset", "sequence", *({schema.GLOBAL_FRAME} & manifest.keys()))
    for key in (*names, "licence"):
        if not isinstance(manifest.get(key), str):
            raise DataError(f"{where}: {key} is no text")
    for name in names:
        require_name(manifest[name], f"{where}: {name}")
    for key in ("camera_names", "lidar_names"):
        found = manifest.get(key)
        if not (isinstance(found, list) and all(isinstance(name, str) for name in found)):
            raise DataError(f"{where}: {key} is no list of names")
    for name in (*manifest["camera_names"], *manifest["lidar_names"]):
        require_name(name, f"{where}: camera or LiDAR")
    if not isinstance(manifest.get("semantic_classes"), dict):
        raise DataError(f"{where}: semantic_classes are no names by class number")
    require_classes(manifest["semantic_classes"], f"{where}: semantic_classes")


def _require_origins(manifest: dict[str, Any], where: str) -> None:
    """What is said of where poses and boxes come from."""
    known = (schema.NO_POSES, schema.LOCALISED)
    if manifest.get(schema.POSES, known[0]) not in known:
        raise DataError(f"{where}: {schema.POSES} says none of {', '.join(known)}")
    scores = manifest.get(schema.LABELLED, {})
    if not (isinstance(scores, dict) and all(map(_is_number, scores.values()))):
        raise DataError(f"{where}: {schema.LABELLED} is no object of scores by actor")
    for name in scores:
        require_name(name, f"{where}: {schema.LABELLED}")


def _require_files(files: object, folder: Path) -> None:
    """Every file listed is a plain one below the folder and has its size; no links, no pipes."""
    where = folder / schema.MANIFEST_NAME
    if not isinstance(files, dict) or len(files) > MAX_FILES:
        raise DataError(f"{where}: files is no object of sizes by name")
    for name, num_bytes in files.items():
        parts = name.split("/")
        if not all(_NAME_PART.fullmatch(part) and part not in (".", "..") for part in parts):
            raise DataError(f"{where}: file name {name!r:.80} leaves the scene or is no plain name")
        try:
            status = (folder / name).lstat()
        except OSError:
            raise DataError(f"{folder / name}: missing, but the manifest lists it") from None
        if not stat.S_ISREG(status.st_mode) or status.st_size != num_bytes:
            raise DataError(
                f"{folder / name}: {status.st_size} bytes, expected a file of {num_bytes!r:.20}"
            )
    for current in (folder, *folder.rglob("*")):
        if current.is_symlink() or not (current.is_file() or current.is_dir()):
            raise DataError(f"{current}: is a link or a pipe, expected files and folders alone")


def _require_entries(manifest: dict[str, Any], where: str) -> None:
    """Digests and shapes of tables and arrays, as far as they can be told without reading them."""
    tables, arrays = manifest.get("tables"), manifest.get("arrays")
    if not isinstance(tables, dict) or set(tables) != set(schema.TABLES):
        raise DataError(f"{where}: tables must be {', '.join(schema.TABLES)}")
    needed = {name for name, layout in schema.ARRAYS.items() if not layout.is_optional}
    if not isinstance(arrays, dict) or not needed <= set(arrays) <= set(schema.ARRAYS):
        raise DataError(f"{where}: arrays must be {', '.join(schema.ARRAYS)}")
    if ("point_semantics" in arrays) != bool(manifest["semantic_classes"]):
        raise DataError(f"{where}: point classes and their names must come together")
    for name, entry in (*tables.items(), *arrays.items()):
        if not isinstance(entry, dict) or not _DIGEST.fullmatch(str(entry.get("sha256"))[:65]):
            raise DataError(f"{where}: {name} has no sha256")
    lengths = {name: _stated_rows(name, entry, where) for name, entry in arrays.items()}
    if len({length for name, length in lengths.items() if name != "image_bytes"}) != 1:
        raise DataError(f"{where}: the arrays of points differ in length")


def _stated_rows(name: str, entry: dict[str, Any], where: str) -> int:
    layout, shape = schema.ARRAYS[name], entry.get("shape")
    if not (isinstance(shape, list) and shape and all(type(size) is int for size in shape)):
        raise DataError(f"{where}: array {name} has no shape")
    if tuple(shape[1:]) != layout.row_shape or not 0 <= shape[0] < 2**48:
        raise DataError(f"{where}: array {name} has the shape {shape!r:.60}")
    if entry.get("dtype") != layout.dtype.name:
        raise DataError(f"{where}: array {name} is not {layout.dtype.name}")
    return shape[0]


def _require_table(file: Path, version: int) -> None:
    """Types, rows and sizes as footer and pages say before any is unpacked, then the rest."""
    name = file.stem
    try:
        _require_footer(pq.read_metadata(file), file)
        columns = [column for column in schema.TABLES[name] if column.since <= version]
        if not pq.read_schema(file).equals(schema.arrow_schema(name, version)):
            raise DataError(f"{file}: the columns or their types are not those of the format")
        # as a dictionary, a text that all rows repeat is unpacked once
        texts = [column.name for column in columns if column.type == pa.string()]
        table = pq.read_table(file, read_dictionary=texts)
        table.validate(full=True)
    except (OSError, ValueError, IndexError, MemoryError, pa.ArrowException) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{file}: no sound Parquet file ({shown(str(error))})") from None
    for text in texts:
        if _text_bytes(table[text]) > MAX_TEXT_BYTES:
            raise DataError(f"{file}: column {text} has more than {MAX_TEXT_BYTES} bytes of texts")
    for column in columns:
        if not column.is_optional and table[column.name].null_count:
            raise DataError(f"{file}: column {column.name} has empty cells")


def _require_footer(footer: pq.FileMetaData, file: Path) -> None:
    groups = [footer.row_group(index) for index in range(footer.num_row_groups)]
    if not 0 <= footer.num_rows <= MAX_TABLE_ROWS:
        raise DataError(f"{file}: {footer.num_rows} rows, expected at most {MAX_TABLE_ROWS}")
    for index in range(footer.num_columns):
        counts = [group.column(index).num_values for group in groups]
        if any(count < 0 for count in counts) or sum(counts) > footer.num_rows * MAX_LIST_LENGTH:
            raise DataError(f"{file}: a column has more values than {MAX_LIST_LENGTH} a row")
    num_bytes = sum(unpacked_bytes(file, footer))
    if num_bytes > MAX_TABLE_BYTES:
        raise DataError(f"{file}: unpacks to {num_bytes} bytes, expected {MAX_TABLE_BYTES} at most")


def _text_bytes(column: pa.ChunkedArray) -> int:
    """What the texts of a column take when every row has its own."""
    return sum(
        pc.sum(pc.binary_length(chunk.dictionary).take(chunk.indices)).as_py() or 0
        for chunk in column.chunks
    )


def _require_group(folder: Path) -> None:
    metadata = read_small_json(folder / "zarr.json")
    if metadata.get("zarr_format") != 3 or metadata.get("node_type") != "group":
        raise DataError(f"{folder / 'zarr.json'}: no group of Zarr version 3")


def _require_array(folder: Path, layout: schema.ArrayLayout, num_rows: int) -> None:
    """The metadata word for word, and no chunk that unpacks to more than its size."""
    file = folder / "zarr.json"
    metadata = read_small_json(file)
    expected = schema.zarr_metadata(layout, num_rows)
    for key, value in expected.items():
        found = metadata.get(key)
        if key == "codecs":
            found = _without_level(found)
        if found != value:
            raise DataError(f"{file}: {key} is {found!r:.120}, expected {value!r:.200}")
    if unknown := set(metadata) - {*expected, "attributes", "dimension_names"}:
        raise DataError(f"{file}: {', '.join(sorted(unknown))!r:.80} is not part of the format")
    chunk_bytes = layout.dtype.itemsize * math.prod((layout.chunk_rows, *layout.row_shape))
    inner = "/".join("0" * len(layout.row_shape))
    for number in range(-(-num_rows // layout.chunk_rows)):
        _require_chunk(folder / "c" / str(number) / inner, chunk_bytes)


def _without_level(codecs: object) -> object:
    """Codecs as in the format, where zstd may have any level."""
    if not isinstance(codecs, list):
        return codecs
    return [
        {"name": "zstd"} if isinstance(codec, dict) and codec.get("name") == "zstd" else codec
        for codec in codecs
    ]


def _require_chunk(file: Path, chunk_bytes: int) -> None:
    """One Zstandard frame (RFC 8878) that states its content size, which is that of a chunk."""
    try:
        with file.open("rb") as opened:
            head = opened.read(18)
        num_bytes = file.stat().st_size
    except OSError:
        raise DataError(f"{file}: missing, but the array has rows there") from None
    if num_bytes > chunk_bytes + chunk_bytes // 8 + _CHUNK_OVERHEAD:
        raise DataError(f"{file}: {num_bytes} bytes for a chunk of {chunk_bytes}")
    if zstd_content_size(head) != chunk_bytes:
        raise DataError(f"{file}: no Zstandard frame that states {chunk_bytes} bytes of content")


def zstd_content_size(head: bytes) -> int | None:
    """The content size a Zstandard frame header states; None if it states none or is no header."""
    if len(head) < 6 or not head.startswith(_ZSTD_MAGIC):
        return None
    descriptor = head[4]
    is_single = bool(descriptor & 0x20)
    size_bytes = (1 if is_single else 0, 2, 4, 8)[descriptor >> 6]
    if size_bytes == 0:
        return None
    start = 5 + (0 if is_single else 1) + (0, 1, 2, 4)[descriptor & 3]
    size = int.from_bytes(head[start : start + size_bytes], "little")
    return size + 256 if size_bytes == 2 else size


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
