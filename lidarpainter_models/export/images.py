"""Images as files: PNG without loss, JPEG for pages."""

import base64
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import WriteError

JPEG_QUALITY = 90


def to_bytes(rgb: Float[Tensor, "height width 3"]) -> np.ndarray:
    """Round rgb in [0, 1] to uint8 (height, width, 3)."""
    return (rgb.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def jpeg_data_url(rgb: Float[Tensor, "height width 3"]) -> str:
    """The image as a JPEG that stands inside a page."""
    bgr = cv2.cvtColor(to_bytes(rgb), cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")


def write_png(rgb: Float[Tensor, "height width 3"], path: Path) -> Path:
    """Write a PNG, folders included.

    Raises:
        WriteError: the file cannot be written.
    """
    bgr = cv2.cvtColor(to_bytes(rgb), cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".png", bgr)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encoded.tobytes())
    except OSError as error:
        raise WriteError(f"cannot write {path}: {error.strerror}") from None
    return path
