"""Pictures of a video that comes as a message each: H.264 or H.265, as Foxglove's messages hold it.

A message holds the whole of one picture (Annex B), and none is stored before one that it needs
(https://docs.foxglove.dev/docs/sdk/schemas/compressed-video): the order is that of the messages.
"""

from collections.abc import Iterator
from typing import Any

from lidarpainter_models.errors import DataError
from lidarpainter_models.scenes.image_bytes import jpeg_of, require_pixels

CODECS = {"h264": "h264", "h265": "hevc", "hevc": "hevc"}


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
