"""Somebody else's Gaussians, as PLY and as SPZ."""

import re
import zlib

from lidarpainter_models.assets.asset_files import SIZE_COMMENT
from lidarpainter_models.assets.foreign_files import MOST_BYTES, ForeignFolder, ForeignShape
from lidarpainter_models.errors import DataError
from lidarpainter_models.export.spz_files import SPZ_FROM_WORLD, read_spz
from lidarpainter_models.gaussians.model.placing import carried_gaussians
from lidarpainter_models.gaussians.model.ply_files import MAX_HEADER_LINES, MAX_LINE_BYTES, read_ply

_SIDE = rb" (\d{1,2}\.\d{1,6})"
_SIZE = re.compile(b"^comment " + SIZE_COMMENT.encode() + 3 * _SIDE + b"$", re.MULTILINE)
_GZIP, _GZIP_BITS = b"\x1f\x8b", 31


def holds_splats(folder: ForeignFolder) -> bool:
    """Whether a PLY file is one of Gaussians."""
    return b" f_dc_0" in _header(folder)


def read_ply_splats(folder: ForeignFolder) -> ForeignShape:
    """Gaussians of a PLY file; raises as `read_ply` does."""
    said = _SIZE.search(_header(folder))
    size_m = None if said is None else (float(said[1]), float(said[2]), float(said[3]))
    return ForeignShape(gaussians=read_ply(folder.file), size_m=size_m)


def read_spz_splats(folder: ForeignFolder) -> ForeignShape:
    """Gaussians of an SPZ file, in its own frame.

    Raises:
        DataError: it is no SPZ file, or is larger than `MOST_BYTES` when it is unpacked.
        MissingPackageError: the extra `export` is not installed.
    """
    unpacking, content = zlib.decompressobj(_GZIP_BITS), folder.content
    try:
        unpacking.decompress(content if content.startswith(_GZIP) else b"", MOST_BYTES)
    except zlib.error as error:
        raise DataError(f"{folder.file}: no readable SPZ file ({error})") from None
    if unpacking.unconsumed_tail:
        raise DataError(f"{folder.file}: unpacks to more than {MOST_BYTES >> 20} MB")
    turned = carried_gaussians(read_spz(folder.file), SPZ_FROM_WORLD)
    return ForeignShape(gaussians=turned, up="y")


def _header(folder: ForeignFolder) -> bytes:
    return folder.content[: MAX_HEADER_LINES * MAX_LINE_BYTES].partition(b"end_header")[0]
