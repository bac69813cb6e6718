"""Messages of MCAP files, one after the other, in bounded memory.

A bag is a file, or a folder of pieces as `ros2 bag record` splits it. Files are read from front to
back (https://mcap.dev/spec), so an index is not needed and a disk is read at its own pace. What a
chunk takes unpacked is bounded while it is unpacked, whatever its header says.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarpainter_models.errors import DataError, MissingPackageError
from lidarpainter_models.scenes.validation import shown

if TYPE_CHECKING:
    from mcap.records import Channel, Chunk, McapRecord, Schema

MAX_RECORD_BYTES = 256 << 20
"""Of a chunk or a message; recorders write chunks of 1 to 4 MB, an image has 10 at most."""
SUFFIX = ".mcap"
_EXTRA = (
    "reading bags needs the packages mcap and mcap-ros2-support: pip install lidarpainter[bags]"
)


@dataclass(frozen=True, slots=True)
class BagMessage:
    """One message as it was recorded."""

    topic: str
    schema: "Schema | None"
    encoding: str
    """Of the message: cdr, protobuf, json."""
    log_ns: int
    """When the recorder got it."""
    data: bytes
    file: Path


def list_bags(root: Path) -> tuple[str, ...]:
    """Names of the bags at a root, sorted.

    A bag is an MCAP file, or a folder of pieces with the metadata.yaml of `ros2 bag record`.
    """
    if root.is_file():
        return (root.stem,) if root.suffix == SUFFIX else ()
    if _is_split(root):
        return (root.resolve().name,)
    split = (path.name for path in root.glob("*") if _is_split(path))
    return tuple(sorted({*split, *(path.stem for path in root.glob(f"*{SUFFIX}"))}))


def bag_files(root: Path, name: str) -> tuple[Path, ...]:
    """The files of a bag in the order of its pieces.

    Raises:
        DataError: there is no such bag at the root.
    """
    for folder in (root, root / name):
        if _is_split(folder) and folder.resolve().name == name:
            return tuple(sorted(folder.glob(f"*{SUFFIX}"), key=_by_number))
    for file in (root, root / f"{name}{SUFFIX}"):
        if file.is_file() and file.name == f"{name}{SUFFIX}":
            return (file,)
    raise DataError(
        f"{root}: no bag {name}, expected {name}{SUFFIX}; `mcap convert` makes it of a .bag or .db3"
    )


def bag_messages(files: tuple[Path, ...]) -> Iterator[BagMessage]:
    """All messages of a bag, in the order in which they were recorded.

    Raises:
        DataError: a file is damaged, or breaks off.
        MissingPackageError: the extra `bags` is not installed.
    """
    for file in files:
        yield from _messages(file)


def _messages(file: Path) -> Iterator[BagMessage]:
    records = _records(file)
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    message_type, channel_type, schema_type = _record_types()
    while True:
        try:
            record = next(records, None)
        except Exception as error:  # noqa: BLE001 - on damaged bytes its readers raise anything
            reason = shown(" ".join(str(error).split())) or type(error).__name__
            raise DataError(
                f"{file}: damaged or broken off ({reason}), expected a whole MCAP file: "
                "`mcap recover` saves what is left"
            ) from None
        if record is None:
            return
        if isinstance(record, schema_type):
            schemas[record.id] = record
        elif isinstance(record, channel_type):
            channels[record.id] = record
        elif isinstance(record, message_type):
            channel = channels.get(record.channel_id)
            if channel is None:
                raise DataError(f"{file}: a message is of channel {record.channel_id}, never named")
            yield BagMessage(
                topic=channel.topic,
                schema=schemas.get(channel.schema_id),
                encoding=channel.message_encoding,
                log_ns=record.log_time,
                data=record.data,
                file=file,
            )


def _records(file: Path) -> "Iterator[McapRecord]":
    """Records in the order of the file, those of chunks among them."""
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader, breakup_chunk

    with file.open("rb") as opened:
        reader = StreamReader(opened, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES)
        for record in reader.records:
            if isinstance(record, Chunk):
                yield from breakup_chunk(_unpacked(record), validate_crc=True)
            else:
                yield record


def _unpacked(chunk: "Chunk") -> "Chunk":
    """A chunk that is not compressed any more.

    Raises:
        ValueError: it takes more than `MAX_RECORD_BYTES`, or is packed in an unknown way.
    """
    if chunk.compression == "zstd":
        import zstandard

        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
            data = stream.read(MAX_RECORD_BYTES + 1)
    elif chunk.compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        data = LZ4FrameDecompressor().decompress(chunk.data, max_length=MAX_RECORD_BYTES + 1)
    elif not chunk.compression:
        return chunk
    else:
        raise ValueError(f"packed as {chunk.compression!r:.20}, expected zstd or lz4")
    if len(data) > MAX_RECORD_BYTES:
        raise ValueError(f"a chunk of more than {MAX_RECORD_BYTES} bytes")
    return replace(chunk, compression="", data=data)


def _record_types() -> tuple[Any, Any, Any]:
    try:
        from mcap.records import Channel, Message, Schema
    except ImportError:
        raise MissingPackageError(_EXTRA) from None
    return Message, Channel, Schema


def _is_split(folder: Path) -> bool:
    return (folder / "metadata.yaml").is_file() and any(folder.glob(f"*{SUFFIX}"))


def _by_number(path: Path) -> tuple[list[int], str]:
    """Piece 10 comes after piece 9."""
    return [int(number) for number in re.findall(r"\d+", path.stem)[-1:]], path.name
