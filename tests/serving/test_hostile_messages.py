"""Whatever comes over the wire is answered by the image it asks for, or by one line."""

import math
import random
import tracemalloc

import cv2
import grpc
import numpy as np
import pytest

from lidarpainter_models.serving import wire
from lidarpainter_models.serving.protos import sensorsim_pb2 as pb

REFUSALS = {
    "NOT_FOUND",
    "INVALID_ARGUMENT",
    "OUT_OF_RANGE",
    "FAILED_PRECONDITION",
}
NUMBERS = (math.nan, math.inf, -math.inf, 1e308, -1e308, 1e-308, 0.0, -1.0, 5.0, 1e9)
SIZES = (0, 1, 2, 7, 96, 8192, 8193, 2**31, 2**32 - 1)
TIMES = (0, 1, 2**53, 2**63, 2**64 - 1)
TOGETHER = ("frame_start_us", "frame_end_us")
NAMES = ("", "..", "../../etc/passwd", "a\nb", "\x00", "nobody", "car-000", "x" * 10_000)
LENGTHS = (0, 1, 2, 3, 6, 7, 25, 10_000)


def spoil_size(message, dice):
    holder = dice.choice((message, message.camera_intrinsics))
    setattr(holder, dice.choice(("resolution_w", "resolution_h")), dice.choice(SIZES))


def spoil_time(message, dice):
    time_us = dice.choice(TIMES)
    for name in dice.choice((("frame_start_us",), ("frame_end_us",), TOGETHER)):
        setattr(message, name, time_us)


def spoil_pose(message, dice):
    pose = dice.choice((message.sensor_pose.start_pose, message.sensor_pose.end_pose))
    holder = dice.choice((pose.vec, pose.quat))
    number = dice.choice(NUMBERS)
    setattr(
        holder, dice.choice("xyz"), max(min(number, 3e38), -3e38) if number == number else number
    )


def spoil_actors(message, dice):
    if dice.random() < 0.1:
        for _ in range(20_000):
            message.dynamic_objects.add()
        return
    for _ in range(dice.choice((1, 3))):
        one = message.dynamic_objects.add(track_id=dice.choice(NAMES))
        if dice.random() < 0.5:
            one.pose_pair.CopyFrom(message.sensor_pose)


def spoil_lens(message, dice):
    spec = message.camera_intrinsics
    kind = dice.choice(("ftheta_param", "opencv_pinhole_param", "opencv_fisheye_param"))
    param = getattr(spec, kind)
    param.SetInParent()
    for name in dice.sample(sorted(param.DESCRIPTOR.fields_by_name), 3):
        field = param.DESCRIPTOR.fields_by_name[name]
        if field.is_repeated:
            numbers = [
                dice.choice((*NUMBERS, 0.1, -0.2, 30.0)) for _ in range(dice.choice(LENGTHS))
            ]
            getattr(param, name).extend(numbers)
        elif field.message_type is None and field.enum_type is None:
            setattr(param, name, dice.choice((*NUMBERS, 50.0, 1.5)))
    if dice.random() < 0.5 and kind != "ftheta_param":
        param.focal_length_x = param.focal_length_y = 40.0
    if dice.random() < 0.3:
        glass = spec.bivariate_windshield_model_param
        glass.reference_poly = dice.choice((0, 1))
        for name in ("horizontal_poly", "vertical_poly", "horizontal_poly_inverse"):
            count = dice.choice((0, 3, 6, 7, 36, 1000))
            getattr(glass, name).extend(dice.choice((*NUMBERS, 0.9)) for _ in range(count))


def spoil_words(message, dice):
    name = dice.choice(("scene_id", "mask", "camera", "format", "quality", "shutter"))
    if name == "scene_id":
        message.scene_id = dice.choice(NAMES)
    elif name == "mask":
        message.insert_ego_mask = True
        message.ego_mask_id.camera_logical_id = dice.choice(NAMES)
    elif name == "camera":
        message.camera_intrinsics.logical_id = dice.choice(NAMES)
    elif name == "format":
        message.image_format = dice.choice((0, 3, 5, 6, 99, -1))
    elif name == "quality":
        message.image_quality = dice.choice((math.nan, -1.0, 101.0, 0.5, 50.0))
    else:
        message.camera_intrinsics.shutter_type = dice.choice((0, 1, 2, 3, 4, 5, 77))


SPOILERS = (spoil_size, spoil_time, spoil_pose, spoil_actors, spoil_lens, spoil_words)


def spoilt(message, seed):
    dice = random.Random(seed)  # noqa: S311
    other = pb.RGBRenderRequest.FromString(message.SerializeToString())
    for _ in range(dice.choice((1, 1, 2, 4))):
        dice.choice(SPOILERS)(other, dice)
    return other


def answer_to(client, message):
    """How many pixels came back, or why none did."""
    call = client.render_rgb.future(message, timeout=120)
    refused = call.exception()
    if refused is not None:
        assert refused.code().name in REFUSALS, (refused.code(), refused.details())
        assert refused.details().isprintable()
        return refused.code().name
    data = call.result().image_bytes
    if message.image_format == pb.RGB_UINT8_PLANAR:
        return len(data) // 3
    shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    return shown.shape[0] * shown.shape[1]


def check(street, client, view, seeds):
    """No message changes what the next one gets."""
    asked = street.request(view)
    expected = client.render_rgb(asked, timeout=120).image_bytes
    found = [answer_to(client, spoilt(asked, seed)) for seed in seeds]
    assert client.render_rgb(asked, timeout=120).image_bytes == expected
    assert {"INVALID_ARGUMENT", "OUT_OF_RANGE"} <= set(found)
    return found


def test_spoilt_messages_get_an_image_or_one_line(street, client, view):
    check(street, client, view, range(60))


@pytest.mark.slow
def test_a_thousand_spoilt_messages_get_an_image_or_one_line(street, client, view):
    tracemalloc.start()
    check(street, client, view, range(500))
    first = tracemalloc.get_traced_memory()[0]
    check(street, client, view, range(500, 1000))
    grown = tracemalloc.get_traced_memory()[0] - first
    tracemalloc.stop()
    assert grown < 2e6, f"{grown / 1e6:.1f} MB are kept of messages that were answered before"


def test_bytes_that_are_no_message_are_refused(channel, client):
    call = channel.unary_unary(
        f"/{wire.service_names()[0]}/render_rgb",
        request_serializer=bytes,
        response_deserializer=bytes,
    )
    for data in (b"\xff" * 100, bytes(range(256)), b"\x0a\xff\xff\xff\xff\x0f"):
        with pytest.raises(grpc.RpcError):
            call(data, timeout=60)
    assert client.get_version(wire.common_pb2.Empty(), timeout=60).version_id
