"""Lenses of requests: messages checked and made into `SensorCamera`."""

import math
from collections.abc import Sequence

from lidarpainter_models.serving.lens_models import (
    PinholeLens,
    RadialLens,
    RisingCurve,
    SensorCamera,
    Windshield,
)
from lidarpainter_models.serving.protos import Message, sensorsim_pb2
from lidarpainter_models.serving.refusals import invalid

MOST_SIDE_PX = 8192
MOST_PIXELS = 2**23
"""Of an image: 3840 x 2160 is within."""
MOST_TERMS = 24
"""Of a polynomial in one variable."""
MOST_OF_TWO = 36
"""Of a polynomial in two variables: order 7."""
TRIANGULAR = {3, 6, 10, 15, 21, 28, MOST_OF_TWO}
IDENTITY = (1.0, 0.0, 0.0, 1.0)


def checked_size(message: Message, spec: Message) -> tuple[int, int]:
    """Width and height of a requested image: those of the lens, or the lens scaled.

    Raises:
        RequestError: INVALID_ARGUMENT, where there is no size, too large a one, or another shape.
    """
    full = (spec.resolution_w, spec.resolution_h)
    if min(full) == 0:
        raise invalid(f"camera_intrinsics has {full[0]} x {full[1]} px: expected the lens' size")
    _check_pixels("camera_intrinsics", full)
    width_px, height_px = message.resolution_w, message.resolution_h
    if width_px == 0 and height_px == 0:
        return full
    width_px = width_px or max(round(height_px * full[0] / full[1]), 1)
    height_px = height_px or max(round(width_px * full[1] / full[0]), 1)
    _check_pixels("the request", (width_px, height_px))
    if abs(width_px * full[1] - height_px * full[0]) > max(full):
        raise invalid(
            f"the request has {width_px} x {height_px} px, its lens {full[0]} x {full[1]} px: "
            "expected the same proportions, the image is scaled and not cut"
        )
    return width_px, height_px


def _check_pixels(what: str, size: tuple[int, int]) -> None:
    if max(size) > MOST_SIDE_PX or size[0] * size[1] > MOST_PIXELS:
        raise invalid(
            f"{what} has {size[0]} x {size[1]} px: expected at most {MOST_SIDE_PX} px a side and "
            f"{MOST_PIXELS} px"
        )


def sensor_camera(spec: Message) -> SensorCamera:
    """The lens of a `CameraSpec` at its own size.

    Raises:
        RequestError: INVALID_ARGUMENT, with the field that makes no sense.
    """
    kind = spec.WhichOneof("camera_param")
    if kind is None:
        raise invalid("camera_intrinsics has no lens: expected ftheta, opencv_pinhole or _fisheye")
    if spec.temporary_camera_spec:
        raise invalid("temporary_camera_spec is not read: expected a lens by its parameters")
    param = getattr(spec, kind)
    middle = (param.principal_point_x, param.principal_point_y)
    _finite("principal_point", middle)
    lens, matrix = {
        "opencv_pinhole_param": _pinhole,
        "opencv_fisheye_param": _fisheye,
        "ftheta_param": _ftheta,
    }[kind](param, spec)
    return SensorCamera(
        lens=lens,
        pixels_per_unit=matrix,
        middle_px=middle,
        width_px=spec.resolution_w,
        height_px=spec.resolution_h,
        windshield=_windshield(spec),
    )


Lens = tuple[PinholeLens | RadialLens, tuple[float, float, float, float]]


def _pinhole(param: Message, _spec: Message) -> Lens:
    return PinholeLens(
        radial=_terms("radial_coeffs", param.radial_coeffs, 6),
        tangential=_terms("tangential_coeffs", param.tangential_coeffs, 2),
        thin_prism=_terms("thin_prism_coeffs", param.thin_prism_coeffs, 4),
    ), _focal(param)


def _fisheye(param: Message, _spec: Message) -> Lens:
    k1, k2, k3, k4 = (*_terms("radial_coeffs", param.radial_coeffs, 4), 0.0, 0.0, 0.0, 0.0)[:4]
    angle_rad = _max_angle(param)
    curve = RisingCurve((0.0, 1.0, 0.0, k1, 0.0, k2, 0.0, k3, 0.0, k4), angle_rad)
    return RadialLens(curve, is_of_angle=True, max_angle_rad=angle_rad), _focal(param)


def _ftheta(param: Message, spec: Message) -> Lens:
    of_angle = _terms("angle_to_pixeldist_poly", param.angle_to_pixeldist_poly, MOST_TERMS)
    of_distance = _terms("pixeldist_to_angle_poly", param.pixeldist_to_angle_poly, MOST_TERMS)
    kinds = sensorsim_pb2.FthetaCameraParam
    is_of_angle = param.reference_poly == kinds.ANGLE_TO_PIXELDIST or not of_distance
    terms = of_angle if is_of_angle else of_distance
    if len(terms) < 2:
        raise invalid("ftheta_param lacks its reference polynomial: expected two terms or more")
    c, d, e = (param.linear_cde.linear_c, param.linear_cde.linear_d, param.linear_cde.linear_e)
    _finite("linear_cde", (c, d, e))
    matrix = (c, d, e, 1.0) if param.HasField("linear_cde") else IDENTITY
    if abs(matrix[0] - matrix[1] * matrix[2]) < 1e-6:
        raise invalid(f"linear_cde {c:g}, {d:g}, {e:g} has no inverse")
    angle_rad = _max_angle(param)
    reach = 2 * math.hypot(spec.resolution_w, spec.resolution_h)
    reach += math.hypot(param.principal_point_x, param.principal_point_y)
    curve = RisingCurve(terms, angle_rad if is_of_angle else reach)
    return RadialLens(curve, is_of_angle=is_of_angle, max_angle_rad=angle_rad), matrix


def _windshield(spec: Message) -> Windshield | None:
    if spec.WhichOneof("external_distortion") is None:
        return None
    param = spec.bivariate_windshield_model_param
    is_forward = param.reference_poly == sensorsim_pb2.BivariateWindshieldModelParameters.FORWARD
    ending = "" if is_forward else "_inverse"
    found = [
        _terms(name, getattr(param, name), MOST_OF_TWO)
        for name in (f"horizontal_poly{ending}", f"vertical_poly{ending}")
    ]
    if not {len(terms) for terms in found} <= TRIANGULAR:
        raise invalid(
            f"the windshield's {ending or 'forward'} polynomials have {len(found[0])} and "
            f"{len(found[1])} terms: expected 3, 6, 10, 15, 21, 28 or 36"
        )
    return Windshield(horizontal=found[0], vertical=found[1], is_forward=is_forward)


def _focal(param: Message) -> tuple[float, float, float, float]:
    focal = (param.focal_length_x, param.focal_length_y)
    if not all(0.01 <= each <= 1e6 for each in focal):
        raise invalid(f"focal_length {focal[0]:g}, {focal[1]:g} px: expected 0.01 to 1000000")
    return focal[0], 0.0, 0.0, focal[1]


def _max_angle(param: Message) -> float:
    """From the axis; half a turn where none is said."""
    angle_rad = float(param.max_angle)
    if not 0 <= angle_rad < math.inf:
        raise invalid(f"max_angle {angle_rad:g}: expected radians from the axis, 0 or more")
    return min(angle_rad, math.pi) if angle_rad else math.pi


def _terms(name: str, values: Sequence[float], most: int) -> tuple[float, ...]:
    if len(values) > most:
        raise invalid(f"{name} has {len(values)} terms: expected at most {most}")
    _finite(name, values)
    return tuple(values)


def _finite(name: str, values: Sequence[float]) -> None:
    if not all(abs(value) <= 1e12 for value in values):
        raise invalid(f"{name} has {', '.join(f'{v:g}' for v in values)}: expected finite numbers")
