"""Images of messages as JPEG: those that are compressed as they are, raw ones and videos encoded.

A video is H.264 or H.265 as Foxglove's messages hold it: a message holds the whole of one picture
(Annex B), and none is stored before one that it needs
(https://docs.foxglove.dev/docs/sdk/schemas/compressed-video): the order is that of the messages.
"""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from lidarpainter_models.errors import DataError
from lidarpainter_models.scenes.image_bytes import as_jpeg, jpeg_of, require_pixels
from lidarpainter_models.scenes.validation import shown

_CHANNELS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1}
_TO_BGR = {
    "rgb8": cv2.COLOR_RGB2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    "mono8": cv2.COLOR_GRAY2BGR,
    "8UC1": cv2.COLOR_GRAY2BGR,
    # OpenCV names a mosaic by its second row, ROS by its first
    "bayer_rggb8": cv2.COLOR_BayerBG2BGR,
    "bayer_bggr8": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGR2BGR,
    "bayer_grbg8": cv2.COLOR_BayerGB2BGR,
}
CODECS = {"h264": "h264", "h265": "hevc", "hevc": "hevc"}


def jpeg_of_message(decoded: Any, where: str) -> bytes:  # noqa: ANN401
    """The image of a CompressedImage, Image or RawImage as JPEG.

    Raises:
        DataError: it is no image, of an encoding that is not known, or smaller than it states.
    """
    if not hasattr(decoded, "encoding"):
        return as_jpeg(bytes(decoded.data), where)
    encoding, step = str(decoded.encoding), int(decoded.step)
    width_px, height_px = int(decoded.width), int(decoded.height)
    if encoding not in {*_CHANNELS, *_TO_BGR}:
        known = ", ".join(sorted({*_CHANNELS, *_TO_BGR}))
        raise DataError(f"{where}: encoding {shown(encoding, 40)!r}, expected one of {known}")
    require_pixels(width_px, height_px, where)
    channels, data = _CHANNELS.get(encoding, 1), bytes(decoded.data)
    if step < width_px * channels or len(data) < step * height_px:
        raise DataError(
            f"{where}: {len(data)} bytes in rows of {step}, expected {height_px} rows of "
            f"{width_px * channels} at least"
        )
    rows = np.frombuffer(data, np.uint8, step * height_px).reshape(height_px, step)
    pixels = np.ascontiguousarray(rows[:, : width_px * channels])
    pixels = pixels.reshape(height_px, width_px, channels)
    return jpeg_of(
        np.asarray(cv2.cvtColor(pixels, _TO_BGR[encoding])) if encoding in _TO_BGR else pixels
    )


class BagVideo:
    """The decoder of one topic."""

    def __init__(self, form: str, where: str) -> None:
        """Take the format that the messages state.

        Raises:
            DataError: it is none of `CODECS`.
        """
        import av

        if form.lower() not in CODECS:
            raise DataError(f"{where}: video format {form!r:.40}, expected {', '.join(CODECS)}")
        self._packet, self._invalid = av.Packet, av.error.FFmpegError
        self._codec: Any = av.CodecContext.create(CODECS[form.lower()], "r")
        self._codec.thread_count = 1  # more threads hold pictures back

    def pictures(
        self, data: bytes | None, number: int, wanted: set[int], where: str
    ) -> Iterator[tuple[int, bytes | None]]:
        """Numbers of the messages whose pictures are there now, and those wanted as JPEG.

        Args:
            data: of the next message; None after the last one.
            number: of that message.
            wanted: numbers of the pictures that are used.
            where: its place, to name in errors.
        """
        packet = None
        if data is not None:
            packet = self._packet(data)
            packet.pts = number
        try:
            frames = self._codec.decode(packet)
        except self._invalid:
            return  # what comes before the first whole picture cannot be shown
        for frame in frames:
            require_pixels(frame.width, frame.height, where)
            shown = frame.pts in wanted
            yield frame.pts, jpeg_of(frame.to_ndarray(format="bgr24")) if shown else None
