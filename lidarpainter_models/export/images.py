"""Images as files: PNG without loss, JPEG and WebP for pages, depth and instances in 16 bits."""

import base64
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.errors import DataError, WriteError
from lidarpainter_models.scenes.image_bytes import decode_image

JPEG = (cv2.IMWRITE_JPEG_QUALITY, 90)
WEBP = (cv2.IMWRITE_WEBP_QUALITY, 80)
DEPTH_UNITS_PER_M = 256
"""Of a depth image, as KITTI has it: 4 mm apart, up to 256 m."""
_MAX_U16 = 65535


def to_bytes(rgb: Float[Tensor, "height width 3"]) -> np.ndarray:
    """Round rgb in [0, 1] to uint8 (height, width, 3)."""
    return (rgb.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def jpeg_data_url(rgb: Float[Tensor, "height width 3"]) -> str:
    """The image as a JPEG that stands inside a page."""
    jpeg = _encoded(_bgr(rgb), ".jpg", JPEG)
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii")


def write_jpeg(rgb: Float[Tensor, "height width 3"], path: Path) -> Path:
    """Write a JPEG, folders included.

    Raises:
        WriteError: the file cannot be written.
    """
    return _write(_bgr(rgb), path, ".jpg", JPEG)


def read_image(path: Path) -> Float[Tensor, "height width 3"]:
    """Read a JPEG or PNG as rgb in [0, 1].

    Raises:
        DataError: it is not there, or no image.
    """
    try:
        bgr = decode_image(path.read_bytes())
    except OSError:
        bgr = None
    if bgr is None:
        raise DataError(f"{path}: expected an image")
    return torch.from_numpy(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)).float() / 255


def small_image(
    rgb: Float[Tensor, "height width 3"], most_px: int
) -> Float[Tensor, "small_height small_width 3"]:
    """The image, at most so wide: pixels are averaged."""
    height, width, _ = rgb.shape
    if width <= most_px:
        return rgb
    size = (most_px, max(round(height * most_px / width), 1))
    return torch.from_numpy(cv2.resize(rgb.detach().numpy(), size, interpolation=cv2.INTER_AREA))


def write_png(rgb: Float[Tensor, "height width 3"], path: Path) -> Path:
    """Write a PNG, folders included.

    Raises:
        WriteError: the file cannot be written.
    """
    return _write(_bgr(rgb), path)


def write_webp(rgb: Float[Tensor, "height width 3"], path: Path) -> Path:
    """Write a small WebP, folders included.

    Raises:
        WriteError: the file cannot be written.
    """
    return _write(_bgr(rgb), path, ".webp", WEBP)


def write_depth_png(depth_m: Float[Tensor, "height width"], path: Path) -> Path:
    """Write camera z in 256ths of a metre, 16 bits; 0 where there is none, 65535 from 256 m on.

    Raises:
        WriteError: the file cannot be written.
    """
    units = (depth_m.detach() * DEPTH_UNITS_PER_M).round().clamp(0, _MAX_U16)
    return _write(units.cpu().numpy().astype(np.uint16), path)


def write_index_png(indices: Int[Tensor, "height width"], path: Path) -> Path:
    """Write numbers from 0 to 65535 as they are, 16 bits.

    Raises:
        WriteError: the file cannot be written.
    """
    return _write(indices.cpu().numpy().astype(np.uint16), path)


def _bgr(rgb: Float[Tensor, "height width 3"]) -> np.ndarray:
    return cv2.cvtColor(to_bytes(rgb), cv2.COLOR_RGB2BGR)


def _encoded(image: np.ndarray, ending: str, options: Sequence[int]) -> bytes:
    return cv2.imencode(ending, image, options)[1].tobytes()


def _write(
    image: np.ndarray, path: Path, ending: str = ".png", options: Sequence[int] = ()
) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(_encoded(image, ending, options))
    except OSError as error:
        raise WriteError(f"cannot write {path}: {error.strerror}") from None
    return path
