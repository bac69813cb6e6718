"""Textures of somebody else's file: opened in one way, bounded, and decoded once each."""

from collections.abc import Iterable
from io import BytesIO
from pathlib import Path

from PIL import Image

from lidarpainter_models.assets.foreign_files import UNREADABLE
from lidarpainter_models.errors import DataError

MOST_PIXELS = 2**26
"""Of one texture."""
MOST_PIXELS_OF_ALL = 2**28
"""Of all textures of a file together."""
BAD_IMAGE = (*UNREADABLE, Image.DecompressionBombError)
"""What Pillow raises about an image that it cannot read, or that says it is far too large."""


def opened_image(file: Path, content: bytes) -> Image.Image:
    """An image whose header could be read; its pixels are not decoded yet.

    Raises:
        DataError: it is no image, or says a size beyond all reason.
    """
    try:
        return Image.open(BytesIO(content))
    except BAD_IMAGE as error:
        raise DataError(f"{file}: its textures cannot be read ({error!r:.200})") from None


def load_images(file: Path, images: Iterable[Image.Image]) -> None:
    """Decode images, each once however often it is in the list.

    Raises:
        DataError: one is too large, all together are, or one cannot be decoded.
    """
    different, total = {id(image): image for image in images}.values(), 0
    for image in different:
        pixels = image.width * image.height
        total += pixels
        if pixels > MOST_PIXELS or total > MOST_PIXELS_OF_ALL:
            said = f"a texture of {image.width} x {image.height} pixels is too large"
            raise DataError(f"{file}: {said}, alone or with all others")
    try:
        for image in different:
            image.load()
    except BAD_IMAGE as error:
        raise DataError(f"{file}: its textures cannot be read ({error!r:.200})") from None
