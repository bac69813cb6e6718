"""Cameras of NCore as lenses of ours.

Pixels are counted from the corner of the first one, but in f-theta cameras from its centre. An
f-theta lens maps the angle from its axis to a distance in the image, or back, by any polynomial of
degree 5. It is taken for the fisheye lens of OpenCV that comes nearest, where that is near enough.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.ncore.sequence import entry, numbers, whole_numbers
from lidarpainter_models.scenes.records import Distortion

Direction = Literal["down", "up", "left", "right"]
SHUTTERS: dict[str, Direction | None] = {
    "GLOBAL": None,
    "ROLLING_TOP_TO_BOTTOM": "down",
    "ROLLING_BOTTOM_TO_TOP": "up",
    "ROLLING_LEFT_TO_RIGHT": "right",
    "ROLLING_RIGHT_TO_LEFT": "left",
}
"""Which way an image is read, by what NCore calls it; None for all of it at once."""
MAX_APART_PX = 0.25
"""Between where an f-theta lens shows a direction and where its fisheye lens does."""
_HALF_PIXEL = 0.5
_SAMPLES = 512
_BROWN_COUNTS = (4, 5, 8)


@dataclass(frozen=True, slots=True, kw_only=True)
class NcoreLens:
    """What a camera looks through, and how its images are read."""

    intrinsics: dict[str, float]
    distortion: Distortion
    width_px: int
    height_px: int
    direction: Direction | None


def lens_of(stated: dict[str, Any], where: str) -> NcoreLens:
    """The lens that a camera's intrinsics state.

    Raises:
        DataError: they are damaged, or of a camera that no lens of ours is.
    """
    model = entry(stated, "camera_model_type", str, where)
    given = entry(stated, "camera_model_parameters", dict, where)
    if given.get("external_distortion_parameters") is not None:
        raise DataError(f"{where}: looks through a windshield, expected a camera without one")
    shutter = entry(given, "shutter_type", str, where)
    if shutter not in SHUTTERS:
        raise DataError(f"{where}: shutter {shutter!r:.40}, expected one of {', '.join(SHUTTERS)}")
    width_px, height_px = whole_numbers(given.get("resolution"), (2,), where).tolist()
    centre_px = numbers(given.get("principal_point"), (2,), where)
    if model == "ftheta":
        centre_px = centre_px + _HALF_PIXEL
        reach_px = np.maximum(centre_px, [width_px, height_px] - centre_px)
        focal_px, distortion = _fisheye_of(given, reach_px, where)
    else:
        focal_px = numbers(given.get("focal_length"), (2,), where)
        distortion = _distortion(model, given, where)
    names = ("fx_px", "fy_px", "cx_px", "cy_px")
    values = (*focal_px.tolist(), *centre_px.tolist())
    return NcoreLens(
        intrinsics=dict(zip(names, values, strict=True)),
        distortion=distortion,
        width_px=width_px,
        height_px=height_px,
        direction=SHUTTERS[shutter],
    )


def _distortion(model: str, given: dict[str, Any], where: str) -> Distortion:
    """What OpenCV's models and the one without any distortion state."""
    if model == "ideal-pinhole":
        return Distortion()
    if model == "opencv-fisheye":
        radial = numbers(given.get("radial_coeffs"), (4,), where)
        return Distortion("fisheye", tuple(radial.tolist()))
    if model not in ("opencv-pinhole", "pinhole"):
        raise DataError(
            f"{where}: camera model {model!r:.40}, expected ideal-pinhole, opencv-pinhole, "
            "opencv-fisheye or ftheta"
        )
    if numbers(given.get("thin_prism_coeffs"), (4,), where).any():
        raise DataError(f"{where}: a lens with thin prism terms, expected them to be 0")
    radial = numbers(given.get("radial_coeffs"), (6,), where)
    tangential = numbers(given.get("tangential_coeffs"), (2,), where)
    terms = (*radial[:2].tolist(), *tangential.tolist(), *radial[2:].tolist())
    count = next(count for count in _BROWN_COUNTS if not any(terms[count:]))
    return Distortion("brown", terms[:count]) if any(terms) else Distortion()


def _fisheye_of(
    given: dict[str, Any], reach_px: Float[np.ndarray, "2"], where: str
) -> tuple[Float[np.ndarray, "2"], Distortion]:
    """Focal lengths and terms of the fisheye lens that comes nearest to an f-theta one."""
    is_forward = entry(given, "reference_poly", str, where) == "ANGLE_TO_PIXELDIST"
    name = "angle_to_pixeldist_poly" if is_forward else "pixeldist_to_angle_poly"
    terms = numbers(given.get(name), (None,), where)
    wider, *shear = numbers(given.get("linear_cde"), (3,), where).tolist()
    farthest_px = float(np.hypot(reach_px[0] / (wider or 1.0), reach_px[1]))
    most_rad = float(numbers(given.get("max_angle"), (), where))
    angle_rad = np.linspace(0.0, min(most_rad, np.pi), _SAMPLES)
    radius_px = np.polynomial.Polynomial(terms)(angle_rad)
    if not is_forward:
        radius_px = np.linspace(0.0, farthest_px, _SAMPLES)
        angle_rad = np.polynomial.Polynomial(terms)(radius_px)
    seen = (radius_px <= farthest_px) & (angle_rad <= most_rad)
    angle_rad, radius_px = angle_rad[seen], radius_px[seen]
    powers = angle_rad[:, None] ** np.array([1, 3, 5, 7, 9])
    is_lens = wider > 0 and (np.diff(angle_rad) > 0).all() and (np.diff(radius_px) > 0).all()
    if len(angle_rad) < powers.shape[1] or not is_lens or not np.isfinite(powers).all():
        raise DataError(f"{where}: an f-theta lens whose polynomial does not rise")
    fitted, *_ = np.linalg.lstsq(powers, radius_px, rcond=None)
    apart_px = float(np.abs(powers @ fitted - radius_px).max()) * max(wider, 1.0)
    apart_px += float(np.abs(shear).sum()) * farthest_px
    if not apart_px <= MAX_APART_PX or fitted[0] <= 0:
        raise DataError(
            f"{where}: no fisheye lens comes nearer to this f-theta lens than {apart_px:.2f} px, "
            f"expected {MAX_APART_PX} px"
        )
    focal_px = fitted[0] * np.array([wider, 1.0])
    return focal_px, Distortion("fisheye", tuple((fitted[1:] / fitted[0]).tolist()))
