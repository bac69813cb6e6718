"""Whatever comes over the wire is answered by what it asks for, or by one line."""

import tracemalloc

import grpc
import pytest
from served_street import served
from spoilt_messages import lenses, spoilt

from lidarpainter_models.serving import wire
from lidarpainter_models.serving.protos import common_pb2
from lidarpainter_models.serving.protos import sensorsim_pb2 as pb

REFUSALS = {
    *("NOT_FOUND", "INVALID_ARGUMENT", "OUT_OF_RANGE", "FAILED_PRECONDITION"),
    "RESOURCE_EXHAUSTED",
}


def answer_to(call, message):
    """What came back, or the name of the code by which nothing did."""
    asked = call.future(message, timeout=120)
    refused = asked.exception()
    if refused is None:
        return asked.result()
    assert refused.code().name in REFUSALS, (refused.code(), refused.details())
    assert refused.details().isprintable()
    return refused.code().name


def check(street, client, view, seeds):
    """No message changes what the next one gets."""
    asked = street.request(view)
    specs = [asked.camera_intrinsics, *lenses(asked.camera_intrinsics).values()]
    expected = client.render_rgb(asked, timeout=120).image_bytes
    found = []
    for seed in seeds:
        other = pb.RGBRenderRequest.FromString(asked.SerializeToString())
        other.camera_intrinsics.CopyFrom(specs[seed % len(specs)])
        answer = answer_to(client.render_rgb, spoilt(other, seed))
        assert isinstance(answer, str) or answer.image_bytes
        found.append(answer)
    assert client.render_rgb(asked, timeout=120).image_bytes == expected
    assert {"INVALID_ARGUMENT", "NOT_FOUND"} <= {one for one in found if isinstance(one, str)}


def test_spoilt_messages_get_an_image_or_one_line(street, client, view):
    check(street, client, view, range(60))


def kept_bytes():
    """What is allocated, but for what checkers of shapes keep of every function inside another."""
    checkers = [tracemalloc.Filter(False, f"*/{name}/*") for name in ("beartype", "jaxtyping")]
    kept = tracemalloc.take_snapshot().filter_traces([*checkers, tracemalloc.Filter(False, "<*>")])
    return sum(one.size for one in kept.statistics("filename"))


@pytest.mark.slow
def test_a_thousand_spoilt_messages_get_an_image_or_one_line(street, client, view):
    tracemalloc.start()
    check(street, client, view, range(500))
    first = kept_bytes()
    check(street, client, view, range(500, 1000))
    grown = kept_bytes() - first
    tracemalloc.stop()
    assert grown < 2e6, f"{grown / 1e6:.1f} MB are kept of messages that were answered before"


def test_every_other_call_answers_what_is_spoilt_in_one_line_too(street, view):
    asked = street.request(view)
    item = pb.BatchRGBRenderRequestItem(camera_name="a", request=asked)
    starts = {
        "batch_render_rgb": pb.BatchRGBRenderRequest(items=[item, item]),
        "render_aggregated": pb.AggregatedRenderRequest(rgb_requests=[asked]),
        "render_lidar": pb.LidarRenderRequest(scene_id="street", sensor_pose=asked.sensor_pose),
        "edit_assets": street.insertion(view, "newcomer"),
    }
    with served(street) as channel:
        client = wire.client(channel)
        for name, (request, _) in wire.calls().items():
            if name != "shut_down":
                for seed in range(12):
                    answer_to(getattr(client, name), spoilt(starts.get(name, request()), seed))


def test_bytes_that_are_no_message_are_refused(channel, client):
    call = channel.unary_unary(
        f"/{wire.service_names()[0]}/render_rgb",
        request_serializer=bytes,
        response_deserializer=bytes,
    )
    for data in (b"\xff" * 100, bytes(range(256)), b"\x0a\xff\xff\xff\xff\x0f"):
        with pytest.raises(grpc.RpcError):
            call(data, timeout=60)
    assert client.get_version(common_pb2.Empty(), timeout=60).version_id
