"""Read TFRecord files: records of bytes, each with two checksums.

A record is its length (uint64, little endian), the masked CRC-32C of those eight bytes, its
content, and the masked CRC-32C of the content. Nothing is believed before its checksum and the size
of the file agree with it, so a hostile length is refused and not allocated.
"""

import hashlib
import stat
import struct
from pathlib import Path

import google_crc32c

from lidarpainter_models.errors import DataError

MAX_RECORD_BYTES = 64 << 20
"""A frame of five cameras and five LiDARs takes 4 to 10 MB."""
MAX_RECORDS = 10_000
"""A segment of 20 s has 200."""
_LENGTH = struct.Struct("<Q")
_CHECKSUM = struct.Struct("<I")
_HEADER_BYTES = _LENGTH.size + _CHECKSUM.size
_MASK_DELTA = 0xA282EAD8
_WORD = 0xFFFFFFFF


class TfrecordFile:
    """The records of one file, read one at a time."""

    def __init__(self, path: Path) -> None:
        """Walk over the lengths of the records; their contents are not read yet.

        Raises:
            DataError: the file is missing, empty, cut off, or a length is not what was written.
        """
        self.path = Path(path)
        self._digest = hashlib.sha256()
        try:
            self._records = self._index()
        except OSError as error:
            raise DataError(f"{self.path}: cannot be read ({error.strerror})") from None
        if not self._records:
            raise DataError(f"{self.path}: zero records, expected at least one")

    @property
    def num_records(self) -> int:
        """How many records there are."""
        return len(self._records)

    def place(self, index: int) -> str:
        """The place to name in errors: file, record and byte."""
        return f"{self.path}, record {index} at byte {self._records[index][0] - _HEADER_BYTES}"

    def read(self, index: int) -> bytes:
        """The content of one record.

        Raises:
            DataError: the content is not what was written.
        """
        offset, num_bytes = self._records[index]
        try:
            with self.path.open("rb") as file:
                file.seek(offset)
                content = file.read(num_bytes)
                checksum = file.read(_CHECKSUM.size)
        except OSError as error:
            raise DataError(f"{self.path}: cannot be read ({error.strerror})") from None
        if len(content) != num_bytes or not _matches(content, checksum):
            raise DataError(
                f"{self.place(index)}: the checksum of its {num_bytes} bytes differs, "
                "expected what was written"
            )
        self._digest.update(content)
        return content

    def provenance(self) -> dict[str, object]:
        """The file, and one digest over the records in the order they were read."""
        return {
            "file": self.path.name,
            "num_records": self.num_records,
            "sha256": self._digest.hexdigest(),
        }

    def _index(self) -> list[tuple[int, int]]:
        """Where the content of each record lies, and its length."""
        records: list[tuple[int, int]] = []
        status = self.path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise DataError(f"{self.path}: not a file")
        size = status.st_size
        position = 0
        with self.path.open("rb") as file:
            while position < size:
                where = f"{self.path}, record {len(records)} at byte {position}"
                if len(records) == MAX_RECORDS:
                    raise DataError(f"{where}: one record too many, expected {MAX_RECORDS} at most")
                file.seek(position)
                num_bytes = _length(file.read(_HEADER_BYTES), where)
                offset = position + _HEADER_BYTES
                position = offset + num_bytes + _CHECKSUM.size
                if position > size:
                    raise DataError(
                        f"{where}: states {num_bytes} bytes, the file ends after "
                        f"{max(size - offset, 0)}"
                    )
                records.append((offset, num_bytes))
        return records


def masked_checksum(content: bytes) -> int:
    """The CRC-32C of some bytes as TFRecord stores it: turned by 15 bits, plus a constant."""
    checksum = google_crc32c.value(content)
    return (((checksum >> 15) | (checksum << 17)) + _MASK_DELTA) & _WORD


def _matches(content: bytes, checksum: bytes) -> bool:
    return checksum == _CHECKSUM.pack(masked_checksum(content))


def _length(header: bytes, where: str) -> int:
    if len(header) < _HEADER_BYTES:
        raise DataError(f"{where}: the file ends inside the length of a record")
    length, checksum = header[: _LENGTH.size], header[_LENGTH.size :]
    if not _matches(length, checksum):
        raise DataError(f"{where}: the checksum of the length differs, expected a TFRecord file")
    (num_bytes,) = _LENGTH.unpack(length)
    if num_bytes > MAX_RECORD_BYTES:
        raise DataError(f"{where}: states {num_bytes} bytes, expected {MAX_RECORD_BYTES} at most")
    return num_bytes
