"""Decode stored images: the one place of the library where bytes of a log become pixels.

Textures of imported meshes are Pillow's, as trimesh wants them (`assets/foreign_images.py`).

A store keeps JPEG images alone: what a log has otherwise is made one here, once.

A lens belongs to the pixels as they lie in the file, so the EXIF tag that asks a viewer to turn an
image is ignored.
"""

import struct

import cv2
import numpy as np
from jaxtyping import UInt8

from lidarpainter_models.errors import DataError

MAX_IMAGE_PIXELS = 64_000_000
"""A header that states more is refused before anything is decoded; cameras have up to 12 million.

A progressive JPEG keeps six bytes per pixel while it is decoded.
"""
_JPEG_START, _PNG_START = b"\xff\xd8", b"\x89PNG"
_PNG_SIZE_AT, _PNG_HEADER_BYTES = 16, 33
_QUALITY = 98
_AS_STORED = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
_EIGHTH = cv2.IMREAD_REDUCED_GRAYSCALE_8 | cv2.IMREAD_IGNORE_ORIENTATION


def decode_image(encoded: bytes) -> np.ndarray | None:
    """Decode a JPEG or PNG image without turning it.

    Args:
        encoded: the bytes of the file.

    Returns:
        BGR pixels as OpenCV orders them, uint8 (height, width, 3); None if the bytes are no image.
    """
    return _decoded(encoded, _AS_STORED)


def can_decode(encoded: bytes) -> bool:
    """Whether bytes are an image, found at an eighth of its size.

    All of the entropy-coded data is read, the rest of the work is spared.
    """
    return _decoded(encoded, _EIGHTH) is not None


def _decoded(encoded: bytes, flags: int) -> np.ndarray | None:
    """What OpenCV makes of the bytes; it raises an error of its own where there are none."""
    return cv2.imdecode(np.frombuffer(encoded, np.uint8), flags) if encoded else None


def as_jpeg(encoded: bytes, where: str) -> bytes:
    """The bytes of a JPEG image as they are, and the pixels of a PNG image as one.

    Args:
        encoded: the bytes of the file.
        where: the place to name in an error.

    Raises:
        DataError: they are neither, or more pixels than a camera has.
    """
    if encoded.startswith(_JPEG_START):
        return encoded
    if not encoded.startswith(_PNG_START) or len(encoded) < _PNG_HEADER_BYTES:
        raise DataError(f"{where}: neither a JPEG nor a PNG image")
    width_px, height_px = struct.unpack_from(">II", encoded, _PNG_SIZE_AT)
    require_pixels(width_px, height_px, where)
    pixels = decode_image(encoded)
    if pixels is None:
        raise DataError(f"{where}: the PNG image cannot be decoded")
    return jpeg_of(pixels)


def jpeg_of(bgr: UInt8[np.ndarray, "height width 3"]) -> bytes:
    """Pixels as a JPEG image that nobody tells from them."""
    return bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1])


def require_pixels(width_px: int, height_px: int, where: str) -> None:
    """Refuse an image of more pixels than a camera has, before any is decoded."""
    if not 0 < width_px * height_px <= MAX_IMAGE_PIXELS:
        raise DataError(
            f"{where}: the image states {width_px} x {height_px} px, expected at most "
            f"{MAX_IMAGE_PIXELS // 1_000_000} million"
        )
