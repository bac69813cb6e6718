"""Decode stored images: the one place of the library where bytes become pixels.

A lens belongs to the pixels as they lie in the file, so the EXIF tag that asks a viewer to turn an
image is ignored.
"""

import cv2
import numpy as np

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
