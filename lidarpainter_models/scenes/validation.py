"""Checks at the border: what a reader hands to the writer must make sense.

Every check takes `where`, the place to name in the error (dataset, sequence, frame, sensor), and
raises a one-line `DataError` that says what is wrong there and what was expected.
"""

import math
from collections.abc import Mapping

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import is_rigid
from lidarpainter_models.scenes.image_bytes import can_decode, require_pixels
from lidarpainter_models.scenes.records import Distortion, RollingShutter
from lidarpainter_models.scenes.schema import MAX_NAME_LENGTH, is_safe_name
from lidarpainter_models.scenes.undistortion import pinhole_of

_JPEG_START = b"\xff\xd8"
_PNG_START = b"\x89PNG"
_JPEG_END = b"\xff\xd9"
# every start-of-frame marker; C4, C8 and CC in the same range mean other things
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
MAX_COORDINATE_M = 100_000.0
"""Farther from the first ego pose than this, float32 is no longer exact to a centimetre."""
MAX_START_M = 10_000.0
"""Between the origin and the first ego pose; float32 is exact to a millimetre there."""
MIN_UPRIGHT = math.cos(math.radians(45.0))
"""Cosine between the ego's z and the world's; no road is as steep."""
MAX_BOX_M = 1000.0
"""Along a side; a train is shorter."""
MAX_LABEL_LENGTH = 200
MAX_PLACE_M = 1e8
"""The Earth's radius is 6.4e6 m; frames of datasets are often centred far away."""
MAX_LENS_NUMBER = 1e7
MAX_SHUTTER_S = 10.0
SHUTTER_DIRECTIONS = ("down", "up", "left", "right")
_MAX_TIMESTAMP_NS = 2**62


def shown(text: str, max_length: int = 200) -> str:
    """A text of unknown origin as one line of bounded length."""
    line = text[:max_length].encode("unicode_escape").decode("ascii")
    return line if len(text) <= max_length else f"{line}..."


def require_name(name: str, kind: str) -> str:
    """Refuse names that would not be one plain folder, `../x` above all."""
    if not is_safe_name(name):
        raise DataError(
            f"{kind} name {name!r:.60} cannot be used: expected at most {MAX_NAME_LENGTH} letters, "
            "digits, '.', '_' or '-', starting with a letter or digit"
        )
    return name


def require_label(label: object, where: str) -> str:
    """Refuse a category that is not a short printable text."""
    if not (isinstance(label, str) and label.isprintable() and 0 < len(label) <= MAX_LABEL_LENGTH):
        raise DataError(
            f"{where}: the category is {label!r:.50}, expected a printable text of at most "
            f"{MAX_LABEL_LENGTH} letters"
        )
    return label


def require_classes(classes: Mapping[str, object], where: str) -> dict[int, str]:
    """Names of point classes by number, from texts as JSON has them; refuse other things."""
    names = {}
    for number, name in classes.items():
        if not (number.isascii() and number.isdecimal() and len(number) <= 3 and int(number) < 256):
            raise DataError(f"{where}: {number!r:.20} is no class number from 0 to 255")
        names[int(number)] = require_label(name, f"{where}, class {number}")
    return names


def require_time(timestamp_ns: int, where: str) -> int:
    """Refuse a time that 64 bits of nanoseconds cannot hold with room to spare."""
    if not -_MAX_TIMESTAMP_NS < timestamp_ns < _MAX_TIMESTAMP_NS:
        raise DataError(f"{where}: the time {float(timestamp_ns) / 1e9:g} s is no date of a log")
    return timestamp_ns


def require_pose(target_from_source: Float[Tensor, "4 4"], where: str) -> Float[Tensor, "4 4"]:
    """Refuse a pose that is not a finite rigid transform."""
    if not bool(torch.isfinite(target_from_source).all()):
        raise DataError(f"{where}: the pose is not finite")
    if not bool(is_rigid(target_from_source)):
        raise DataError(f"{where}: the pose is not a rotation and a translation")
    if float(target_from_source[:3, 3].abs().max()) > MAX_PLACE_M:
        raise DataError(f"{where}: the pose lies farther away than the Earth is wide")
    return target_from_source


def require_start(world_from_ego: Float[Tensor, "4 4"], where: str) -> None:
    """Refuse a world that does not begin near its first ego pose, or whose z is not up."""
    away_m = float(world_from_ego[:3, 3].norm())
    if away_m > MAX_START_M:
        raise DataError(
            f"{where}: the first ego pose is {away_m:.0f} m from the world's origin, expected at "
            f"most {MAX_START_M:.0f} m: subtract the first position from all poses and points"
        )
    if float(world_from_ego[2, 2]) < MIN_UPRIGHT:
        lean_deg = math.degrees(math.acos(max(float(world_from_ego[2, 2]), -1.0)))
        raise DataError(
            f"{where}: the ego's z axis leans {lean_deg:.0f} degrees from the world's, expected "
            "both to point up"
        )


def require_lens(camera: Camera, distortion: Distortion, where: str) -> None:
    """Refuse a lens whose numbers are no lens, or whose distortion cannot be undone."""
    numbers = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *distortion.terms)
    if not all(abs(number) <= MAX_LENS_NUMBER for number in numbers):
        raise DataError(f"{where}: the lens has a number beyond {MAX_LENS_NUMBER:g}")
    try:
        pinhole_of(camera, distortion)
    except (cv2.error, ConfigError, OverflowError):
        raise DataError(
            f"{where}: the {distortion.model} distortion {distortion.terms} cannot be undone"
        ) from None


def require_shutter(shutter: RollingShutter | None, where: str) -> None:
    """Refuse a shutter that takes no time, too long, or reads in no direction."""
    if shutter is None:
        return
    if not 0 <= shutter.duration_s <= MAX_SHUTTER_S or shutter.direction not in SHUTTER_DIRECTIONS:
        raise DataError(
            f"{where}: the rolling shutter reads {shutter.direction!r:.20} for "
            f"{shutter.duration_s} s, expected {', '.join(SHUTTER_DIRECTIONS)} and at most "
            f"{MAX_SHUTTER_S} s"
        )
    if not abs(shutter.middle_s) <= MAX_SHUTTER_S:
        raise DataError(
            f"{where}: the first row is read {shutter.first_row_s} s after the timestamp, expected "
            f"at most {MAX_SHUTTER_S} s before or after"
        )


def require_points(xyz_m: np.ndarray, where: str) -> None:
    """Refuse a sweep without points, or with points that are not finite or absurdly far."""
    if len(xyz_m) == 0:
        raise DataError(f"{where}: zero points, expected at least one")
    finite = np.isfinite(xyz_m).all(axis=1)
    if not finite.all():
        raise DataError(f"{where}: {int((~finite).sum())} of {len(xyz_m)} points are not finite")
    farthest_m = float(np.abs(xyz_m).max())
    if farthest_m > MAX_COORDINATE_M:
        raise DataError(
            f"{where}: a point is {farthest_m:.0f} m from the world origin, expected less than "
            f"{MAX_COORDINATE_M:.0f} m (the origin is the first ego pose)"
        )


def require_size(size_m: tuple[float, float, float], where: str) -> None:
    """Refuse a box whose length, width or height is zero, negative, endless or not a number."""
    if not all(0 < size <= MAX_BOX_M for size in size_m):
        shown = " x ".join(f"{size:g}" for size in size_m)
        raise DataError(
            f"{where}: the box measures {shown} m, expected positive sizes, {MAX_BOX_M:.0f} m at "
            "most"
        )


def require_jpeg(jpeg: bytes, *, width_px: int, height_px: int, where: str) -> None:
    """Refuse bytes that are no complete JPEG image of the stated size.

    A decoder fills a cut-off image with grey and says nothing, so the end-of-image marker is
    looked for as well.
    """
    found_px = jpeg_header_size(jpeg, where)
    if found_px != (width_px, height_px):
        raise DataError(
            f"{where}: the image is {found_px[0]} x {found_px[1]} px, "
            f"expected {width_px} x {height_px}"
        )
    if not jpeg.rstrip(b"\x00").endswith(_JPEG_END):
        raise DataError(f"{where}: the JPEG image is cut off ({len(jpeg)} bytes, no end marker)")
    if not can_decode(jpeg):
        raise DataError(f"{where}: the JPEG image cannot be decoded")


def jpeg_header_size(jpeg: bytes, where: str) -> tuple[int, int]:
    """Width and height a JPEG's header states, read without decoding the image.

    Segments follow each other as marker, big-endian length, content (ITU-T T.81, annex B); the
    size stands in the start-of-frame segment.
    """
    if jpeg.startswith(_PNG_START):
        raise DataError(
            f"{where}: a PNG image, expected JPEG: convert it, as docs/examples/nerfstudio.py does"
        )
    if not jpeg.startswith(_JPEG_START):
        raise DataError(f"{where}: not a JPEG image")
    position = len(_JPEG_START)
    while position + 9 <= len(jpeg) and jpeg[position] == 0xFF:
        marker = jpeg[position + 1]
        if marker in _START_OF_FRAME:
            height_px = int.from_bytes(jpeg[position + 5 : position + 7], "big")
            width_px = int.from_bytes(jpeg[position + 7 : position + 9], "big")
            require_pixels(width_px, height_px, where)
            return width_px, height_px
        if marker == 0xFF:  # padding before a marker
            position += 1
            continue
        position += 2 + int.from_bytes(jpeg[position + 2 : position + 4], "big")
    raise DataError(f"{where}: not a JPEG image with a readable header")
