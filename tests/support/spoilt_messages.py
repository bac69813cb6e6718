"""Requests of simulators in which something makes no sense, drawn from a seed."""

import math
import random

from lidarpainter_models.serving.protos import sensorsim_pb2 as pb

NUMBERS = (math.nan, math.inf, -math.inf, 3e38, -3e38, 1e-38, 0.0, -1.0, 0.1, 5.0, 50.0, 1e9)
COUNTS = (0, 1, 2, 7, 96, 8192, 8193, 2**31 - 1)
LARGER = (2**31, 2**32 - 1)
TIMES = (0, 1, 2**53, 2**63, 2**64 - 1)
NAMES = ("", "..", "../../etc/passwd", "a\nb", "\x00", "nobody", "car-000", "x" * 10_000)
LENGTHS = (0, 1, 2, 3, 6, 7, 25, 10_000)
MANY = 20_000
"""Messages in a list, now and then."""


def lenses(spec):
    """A lens of every kind, all before images of the size of a pinhole's, by name."""
    width_px = spec.resolution_w
    middle = {"principal_point_x": width_px / 2, "principal_point_y": spec.resolution_h / 2}
    focal = {"focal_length_x": 0.7 * width_px, "focal_length_y": 0.7 * width_px}
    size = {"resolution_w": width_px, "resolution_h": spec.resolution_h}
    rational = pb.OpenCVPinholeCameraParam(
        **middle, **focal, radial_coeffs=[-0.2, 0.05], tangential_coeffs=[0.001, -0.002]
    )
    fisheye = pb.OpenCVFisheyeCameraParam(
        **middle,
        focal_length_x=0.3 * width_px,
        focal_length_y=0.3 * width_px,
        radial_coeffs=[-0.02, 0.002],
        max_angle=math.radians(95),
    )
    ftheta = pb.FthetaCameraParam(
        **middle,
        reference_poly=pb.FthetaCameraParam.ANGLE_TO_PIXELDIST,
        angle_to_pixeldist_poly=[0.0, 0.6 * width_px, 0.0, -0.02 * width_px],
        max_angle=1.2,
    )
    glass = pb.BivariateWindshieldModelParameters(
        horizontal_poly=[0.001, 1.01, 0.02], vertical_poly=[0.0, 0.002, 1.005]
    )
    named = {"logical_id": spec.logical_id, **size}
    return {
        "rational": pb.CameraSpec(opencv_pinhole_param=rational, **named),
        "fisheye": pb.CameraSpec(opencv_fisheye_param=fisheye, **named),
        "f-theta": pb.CameraSpec(ftheta_param=ftheta, **named),
        "windshield": pb.CameraSpec(
            opencv_pinhole_param=rational, bivariate_windshield_model_param=glass, **named
        ),
    }


def spoilt(message, seed):
    """A copy of a message with one to four fields, anywhere in it, changed to what is odd."""
    dice = random.Random(seed)  # noqa: S311
    other = type(message).FromString(message.SerializeToString())
    for _ in range(dice.choice((1, 1, 2, 4))):
        _spoil(other, dice)
    return other


def _spoil(message, dice):
    fields = message.DESCRIPTOR.fields
    if not fields:
        return
    field = dice.choice(fields)
    held = getattr(message, field.name)
    if field.message_type is None:
        if field.is_repeated:
            held.extend(_value(field, dice) for _ in range(dice.choice(LENGTHS)))
        else:
            setattr(message, field.name, _value(field, dice))
    elif not field.is_repeated:
        held.SetInParent()
        _spoil(held, dice)
    elif dice.random() < 0.05:
        for _ in range(MANY):
            held.add()
    else:
        _spoil(dice.choice(held) if held and dice.random() < 0.7 else held.add(), dice)


def _value(field, dice):
    if field.enum_type is not None:
        return dice.choice((0, 1, 2, 3, 4, 5, 6, 77, -1))
    kinds = {
        field.CPPTYPE_BOOL: (True, False),
        field.CPPTYPE_STRING: NAMES,
        field.CPPTYPE_DOUBLE: NUMBERS,
        field.CPPTYPE_FLOAT: NUMBERS,
        field.CPPTYPE_UINT64: TIMES,
        field.CPPTYPE_UINT32: (*COUNTS, *LARGER),
    }
    return dice.choice(kinds.get(field.cpp_type, COUNTS))
