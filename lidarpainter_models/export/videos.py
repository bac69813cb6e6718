"""Images as a film: H.264 in an MP4, which browsers and every player show."""

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ConfigError, WriteError
from lidarpainter_models.export.images import to_bytes
from lidarpainter_models.storage.whole_files import whole_file

CRF = 18
"""Constant rate factor of x264: a loss that eyes hardly find."""
MAX_FPS = 240.0
_TIME_BASE = 90_000  # ticks a second, as MP4 files commonly have


class VideoWriter:
    """A film that is being written; all images have the size of the first."""

    def __init__(self, container: Any, fps: float) -> None:  # noqa: ANN401 - of PyAV
        self._container = container
        self._fps = fps
        self._stream: Any = None
        self.num_images = 0

    def add(self, rgb: Float[Tensor, "height width 3"]) -> None:
        """Append an image; an odd size is cut by one pixel, which the format needs."""
        import av

        image = to_bytes(rgb[: rgb.shape[0] // 2 * 2, : rgb.shape[1] // 2 * 2])
        if self._stream is None:
            self._stream = self._open(image)
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709")
        frame.pts = round(self.num_images * _TIME_BASE / self._fps)
        frame.time_base = Fraction(1, _TIME_BASE)
        self._container.mux(self._stream.encode(frame))
        self.num_images += 1

    def finish(self) -> None:
        """Write what the encoder still holds back."""
        if self._stream is not None:
            self._container.mux(self._stream.encode(None))

    def _open(self, image: np.ndarray) -> Any:  # noqa: ANN401
        rate = Fraction(self._fps).limit_denominator(1001)
        stream = self._container.add_stream("libx264", rate=rate, options={"crf": str(CRF)})
        stream.height, stream.width = image.shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, _TIME_BASE)
        for name in ("colorspace", "color_primaries", "color_trc"):
            setattr(stream.codec_context, name, 1)  # BT.709, whatever the size
        return stream


@contextmanager
def video_file(path: Path, fps: float) -> Iterator[VideoWriter]:
    """Write a film aside and rename it whole.

    Raises:
        ConfigError: no such number of images a second.
        WriteError: the disk or the encoder refuses.
    """
    if not 0 < fps <= MAX_FPS:
        raise ConfigError(f"--fps {fps:g}: expected above 0 and at most {MAX_FPS:g}")
    import av

    with whole_file(path) as aside:
        try:
            with av.open(str(aside), "w", format="mp4", options={"movflags": "faststart"}) as made:
                writer = VideoWriter(made, fps)
                yield writer
                writer.finish()
        except av.FFmpegError as error:
            raise WriteError(f"{path}: cannot be written: {error}") from error


def images_per_second(timestamps_ns: list[int]) -> float:
    """At which rate recorded moments follow each other; 10 where there is one alone."""
    if len(timestamps_ns) < 2:
        return 10.0
    steps_s = torch.tensor(timestamps_ns).diff().double() * 1e-9
    return round(1.0 / float(steps_s.median()), 3)
