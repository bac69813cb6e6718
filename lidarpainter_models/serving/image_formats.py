"""Images as bytes, in the formats that simulators ask for."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from lidarpainter_models.serving.protos import sensorsim_pb2
from lidarpainter_models.serving.refusals import RequestError, invalid

QUALITY = 95
"""Of a JPEG where none is asked for."""
FALLING = (90, 80, 70, 55, 40, 25, 10)
"""Qualities that are tried one after the other until an image is small enough."""
PLANAR = ""
_ENDINGS: dict[int, str] = {
    sensorsim_pb2.UNDEFINED: ".png",
    sensorsim_pb2.PNG: ".png",
    sensorsim_pb2.JPEG: ".jpg",
    sensorsim_pb2.JPEG2000: ".jp2",
    sensorsim_pb2.RGB_UINT8_PLANAR: PLANAR,
}


@dataclass(frozen=True)
class Encoding:
    """A format, and how good it is."""

    ending: str = ".png"
    """As of a file; empty for planes of red, green and blue, one after the other."""
    quality: int = QUALITY
    """1 to 100; of a JPEG alone."""


def encoding_of(image_format: int, quality: float) -> Encoding:
    """The encoding that a request names; no format is PNG, no quality 95.

    Qualities up to 1 are parts of the best one: some clients count so, and nobody wants 1 of 100.

    Raises:
        RequestError: INVALID_ARGUMENT, for films and for what is unknown.
    """
    if image_format not in _ENDINGS:
        names = sensorsim_pb2.ImageFormat.items()
        name = next((name for name, number in names if number == image_format), image_format)
        raise invalid(
            f"image_format {name}: expected PNG, JPEG, JPEG2000 or RGB_UINT8_PLANAR, since every "
            "image is answered alone"
        )
    ending = _ENDINGS[image_format]
    if ending and not cv2.haveImageWriter(f"image{ending}"):
        raise invalid(f"image_format {ending}: the OpenCV of this server cannot write it")
    if not 0 <= quality <= 100:  # NaN too
        raise invalid(f"image_quality {quality:g}: expected 0 to 1, or 1 to 100")
    of_100 = 100 * quality if quality <= 1 else quality
    return Encoding(ending, round(of_100) or QUALITY)


def encoded(rgb_u8: UInt8[np.ndarray, "height width 3"], encoding: Encoding) -> bytes:
    """An image in an encoding."""
    if encoding.ending == PLANAR:
        return rgb_u8.transpose(2, 0, 1).tobytes()
    options = [cv2.IMWRITE_JPEG_QUALITY, encoding.quality] if encoding.ending == ".jpg" else []
    if encoding.ending == ".png":
        options = [cv2.IMWRITE_PNG_COMPRESSION, 1]  # as fast as it gets without loss
    done, data = cv2.imencode(encoding.ending, np.ascontiguousarray(rgb_u8[..., ::-1]), options)
    if not done:
        raise invalid(f"image_format {encoding.ending}: OpenCV cannot write this image")
    return data.tobytes()


def encoded_within(
    rgb_u8: UInt8[np.ndarray, "height width 3"], encoding: Encoding, most_bytes: int
) -> bytes:
    """An image in an encoding, or as a JPEG that is as good as so many bytes allow.

    Raises:
        RequestError: RESOURCE_EXHAUSTED, where no JPEG is small enough.
    """
    for tried in (encoding, *(Encoding(".jpg", quality) for quality in FALLING)):
        data = encoded(rgb_u8, tried)
        if len(data) <= most_bytes:
            return data
    raise RequestError(
        "RESOURCE_EXHAUSTED",
        f"an image of {rgb_u8.shape[1]} x {rgb_u8.shape[0]} px takes {len(data)} bytes as a JPEG "
        f"of quality {FALLING[-1]}: expected at most {most_bytes}",
    )
