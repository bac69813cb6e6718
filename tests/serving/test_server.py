"""Clients made from the messages alone, on a real socket."""

import math
import threading
from concurrent.futures import ThreadPoolExecutor

import cv2
import grpc
import numpy as np
import pytest
import torch
from served_street import placed_object, served

from lidarpainter_models.serving import wire
from lidarpainter_models.serving.protos import common_pb2
from lidarpainter_models.serving.protos import sensorsim_pb2 as pb
from lidarpainter_models.serving.refusals import RequestError
from lidarpainter_models.serving.render_queue import RenderQueue
from lidarpainter_models.serving.trust import KEYS

SCENE = {"scene_id": "street"}


def decoded(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def as_bytes(rgb):
    return (rgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def code_of(call, message, **options):
    with pytest.raises(grpc.RpcError) as refused:
        call(message, timeout=60, **options)
    assert "\n" not in refused.value.details()
    return refused.value.code().name, refused.value.details()


@pytest.mark.parametrize("package", wire.PACKAGES)
def test_the_service_answers_under_every_name(channel, package):
    client = wire.client(channel, package)
    found = client.get_available_scenes(common_pb2.Empty(), timeout=60)
    assert list(found.scene_ids) == ["street"]
    version = client.get_version(common_pb2.Empty(), timeout=60).grpc_api_version
    assert (version.major, version.minor, version.patch) == (0, 0, 5)


def test_health_and_reflection_tell_of_every_name(channel):
    from google.protobuf.descriptor_pool import DescriptorPool
    from grpc_health.v1 import health_pb2, health_pb2_grpc
    from grpc_reflection.v1alpha.proto_reflection_descriptor_database import (
        ProtoReflectionDescriptorDatabase,
    )

    health = health_pb2_grpc.HealthStub(channel)
    reflected = DescriptorPool(ProtoReflectionDescriptorDatabase(channel))
    for name in wire.service_names():
        state = health.Check(health_pb2.HealthCheckRequest(service=name), timeout=60)
        assert state.status == health_pb2.HealthCheckResponse.SERVING
        methods = reflected.FindServiceByName(name).methods_by_name
        assert set(methods) == set(wire.calls())
        package = name.rpartition(".")[0]
        assert methods["render_rgb"].input_type.full_name == f"{package}.RGBRenderRequest"


def test_a_recorded_pose_gives_the_image_of_render(street, client, view):
    camera = street.served.found(view)
    expected = street.scene.render(camera, view.timestamp_ns, camera_name=view.camera_name).rgb
    reply = client.render_rgb(street.request(view), timeout=60)
    assert np.array_equal(decoded(reply.image_bytes), as_bytes(expected))


def test_a_smaller_image_is_scaled(street, client, view):
    camera = street.served.found(view).resized(width_px=48, height_px=27)
    expected = street.scene.render(camera, view.timestamp_ns, camera_name=view.camera_name).rgb
    message = street.request(view, resolution_w=48, resolution_h=27)
    reply = client.render_rgb(message, timeout=60)
    assert np.array_equal(decoded(reply.image_bytes), as_bytes(expected))


def test_actors_that_are_left_out_are_not_drawn(street, client, view):
    with_all = decoded(client.render_rgb(street.request(view), timeout=60).image_bytes)
    without = decoded(client.render_rgb(street.request(view, actors=[]), timeout=60).image_bytes)
    drawn = street.scene.drawable(street.served.found(view), view.timestamp_ns)
    shows_actors = drawn.render().actor_alpha > 0.05
    changed = torch.from_numpy(np.abs(with_all.astype(int) - without).max(axis=-1) > 0)
    assert bool(changed.any())
    assert not bool((changed & ~(drawn.render().actor_alpha > 0)).any())
    assert float((changed & shows_actors).sum()) > 0.5 * float(shows_actors.sum())


def test_an_actor_stands_where_the_request_has_it(street, client, view):
    """Two metres in front of the camera a car fills most of the image."""
    camera = street.served.found(view)
    ahead = torch.eye(4, dtype=torch.float64)
    ahead[:3, 3] = torch.tensor([0.0, 0.5, 6.0])
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]).double().T
    placed = camera.world_from_camera @ ahead @ turn.T
    name = street.scene.actors.recorded_tracks[0].actor_id
    alone = street.request(view, actors=[placed_object(name, placed)])
    shown = decoded(client.render_rgb(alone, timeout=60).image_bytes)
    nobody = decoded(client.render_rgb(street.request(view, actors=[]), timeout=60).image_bytes)
    changed = np.abs(shown.astype(int) - nobody).max(axis=-1) > 0
    columns = np.nonzero(changed)[1]
    assert changed.any()
    assert abs(columns.mean() + 0.5 - camera.cx_px) < 0.15 * camera.width_px


def test_trust_comes_as_trailing_metadata(street, client, view):
    _, call = client.render_rgb.with_call(street.request(view), timeout=60)
    found = dict(call.trailing_metadata())
    assert 0 <= float(found[KEYS[0]]) <= 1
    assert 0 < float(found[KEYS[1]]) < 60
    assert found[KEYS[2]] == ""  # a scene without an envelope


def test_a_bad_item_of_a_batch_leaves_the_others(street, channel, view):
    items = [
        pb.BatchRGBRenderRequestItem(camera_name="first", request=street.request(view)),
        pb.BatchRGBRenderRequestItem(camera_name="bad", request=pb.RGBRenderRequest(**SCENE)),
        pb.BatchRGBRenderRequestItem(camera_name="last", request=street.request(view)),
    ]
    for package in wire.PACKAGES:
        client = wire.client(channel, package)
        call = client.batch_render_camera if package == "sensorsim" else client.batch_render_rgb
        reply, told = call.with_call(pb.BatchRGBRenderRequest(items=items), timeout=60)
        assert [item.success for item in reply.items] == [True, False, True]
        assert [item.camera_name for item in reply.items] == ["first", "bad", "last"]
        assert "camera_intrinsics" in reply.items[1].error_message
        assert reply.items[0].result.image_bytes == reply.items[2].result.image_bytes
        assert dict(told.trailing_metadata())[KEYS[0]].split(",")[1] == ""


def test_an_aggregated_request_is_drawn_and_a_refused_part_refuses_it(street, client, view):
    asked = pb.AggregatedRenderRequest(rgb_requests=[street.request(view)])
    reply = client.render_aggregated(asked, timeout=60)
    alone = client.render_rgb(street.request(view), timeout=60)
    assert reply.rgb_returns[0].image_bytes == alone.image_bytes
    asked.lidar_requests.add(**SCENE)
    assert code_of(client.render_aggregated, asked)[0] == "INVALID_ARGUMENT"


def test_every_refusal_has_its_code(street, client, view):
    asked = street.request(view)

    def changed(**fields):
        other = pb.RGBRenderRequest.FromString(asked.SerializeToString())
        for name, value in fields.items():
            setattr(other, name, value)
        return other

    late = changed(frame_start_us=2**45, frame_end_us=2**45)
    stranger = changed()
    stranger.dynamic_objects.add(track_id="nobody").pose_pair.CopyFrom(asked.sensor_pose)
    squeezed = changed(resolution_w=48, resolution_h=54)
    backwards = changed(frame_end_us=asked.frame_start_us - 1)
    film = changed(image_format=pb.AVC)
    expected = [
        (changed(scene_id="elsewhere"), "NOT_FOUND", "elsewhere"),
        (late, "OUT_OF_RANGE", "was recorded from"),
        (stranger, "INVALID_ARGUMENT", "'nobody'"),
        (squeezed, "INVALID_ARGUMENT", "proportions"),
        (changed(resolution_w=0, resolution_h=8192), "INVALID_ARGUMENT", "14564 x 8192"),
        (backwards, "INVALID_ARGUMENT", "before"),
        (film, "INVALID_ARGUMENT", "AVC"),
    ]
    for message, code, words in expected:
        found, line = code_of(client.render_rgb, message)
        assert found == code, line
        assert words in line


def test_untrusted_frames_are_refused_where_that_is_asked_for(street, view):
    with served(street, refuse_below=0.999) as channel:
        call = wire.client(channel).render_rgb
        with pytest.raises(grpc.RpcError) as refused:
            call(street.request(view), timeout=60)
    assert refused.value.code() == grpc.StatusCode.FAILED_PRECONDITION
    assert "confidence" in refused.value.details()
    assert float(dict(refused.value.trailing_metadata())[KEYS[0]]) < 0.999


def test_a_reply_is_as_small_as_it_is_asked_to_be(street, client, view):
    asked = street.request(view)
    whole = len(client.render_rgb(asked, timeout=60).image_bytes)
    limit = (("lidarpainter-max-reply-bytes", str(whole // 2)),)
    small = client.render_rgb(asked, timeout=60, metadata=limit)
    assert len(small.image_bytes) <= whole // 2
    assert small.image_bytes[:2] == b"\xff\xd8"
    none = (("lidarpainter-max-reply-bytes", "1000"),)
    items = [pb.BatchRGBRenderRequestItem(request=asked) for _ in range(3)]
    reply = client.batch_render_rgb(
        pb.BatchRGBRenderRequest(items=items), timeout=60, metadata=none
    )
    assert [item.success for item in reply.items] == [False] * 3


@pytest.mark.parametrize(
    ("image_format", "beginning"), [(pb.JPEG, b"\xff\xd8"), (pb.PNG, b"\x89PNG")]
)
def test_images_come_in_the_format_that_is_asked_for(street, client, view, image_format, beginning):
    data = client.render_rgb(street.request(view, image_format=image_format)).image_bytes
    assert data.startswith(beginning)


def test_planes_of_colours_are_the_pixels_themselves(street, client, view):
    planar = client.render_rgb(street.request(view, image_format=pb.RGB_UINT8_PLANAR))
    png = client.render_rgb(street.request(view))
    planes = np.frombuffer(planar.image_bytes, np.uint8).reshape(
        3, *decoded(png.image_bytes).shape[:2]
    )
    assert np.array_equal(planes.transpose(1, 2, 0), decoded(png.image_bytes))


def test_a_client_is_told_of_cameras_ways_and_actors(street, client):
    found = client.get_available_cameras(pb.AvailableCamerasRequest(**SCENE), timeout=60)
    cameras = {one.logical_id: one for one in found.available_cameras}
    assert set(cameras) == set(street.recording.camera_names)
    seat = cameras["front_camera"].rig_to_camera.vec
    rig = next(one for one in street.config.cameras if one.name == "front_camera")
    assert (seat.x, seat.y, seat.z) == pytest.approx(
        (rig.forward_m, rig.left_m, rig.up_m), abs=0.05
    )
    ways = client.get_available_trajectories(pb.AvailableTrajectoriesRequest(**SCENE), timeout=60)
    (way,) = (one.trajectory for one in ways.available_trajectories)
    assert len(way.poses) == street.config.num_frames
    assert math.hypot(way.poses[0].pose.vec.x, way.poses[0].pose.vec.y) < 0.2
    actors = client.get_dynamic_objects(pb.DynamicObjectsRequest(**SCENE), timeout=60)
    assert {one.id for one in actors.dynamic_objects} == {
        track.actor_id for track in street.recording.tracks
    }
    loaded = client.get_loaded_scenes(common_pb2.Empty(), timeout=60)
    assert [one.scene_id for one in loaded.scenes] == ["street"]


def test_only_a_server_that_may_be_ended_is(street):
    stopped = threading.Event()
    with served(street) as channel:
        call = wire.client(channel).shut_down
        assert code_of(call, common_pb2.Empty())[0] == "FAILED_PRECONDITION"
    with served(street, shut_down_asked=stopped.set) as channel:
        wire.client(channel).shut_down(common_pb2.Empty(), timeout=60)
    assert stopped.is_set()


def test_eight_clients_get_what_one_gets(street, client):
    views = [street.recording.views_of("front_camera")[number % 5] for number in range(8)]
    messages = [street.request(one) for one in views]
    alone = [client.render_rgb(message, timeout=60).image_bytes for message in messages]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(lambda m: client.render_rgb(m, timeout=60).image_bytes, messages))
    assert alone == together


def test_a_full_queue_refuses_and_equal_work_is_done_once():
    queue, begin, done = RenderQueue(1, 60.0), threading.Event(), []

    def work():
        begin.wait(60)
        done.append(1)
        return len(done)

    with ThreadPoolExecutor(2) as pool:
        same = [pool.submit(queue.answer, "same", work) for _ in range(2)]
        while "same" not in queue._pending:
            pass
        with pytest.raises(RequestError, match="wait") as refused:
            queue.answer("other", work)
        begin.set()
        assert [one.result(60) for one in same] in ([1, 1], [1, 2])
    assert refused.value.code == "RESOURCE_EXHAUSTED"
    queue.close()


def test_work_that_takes_too_long_is_said_to():
    queue, end = RenderQueue(4, 0.05), threading.Event()
    with pytest.raises(RequestError, match="within") as refused:
        queue.answer("slow", lambda: end.wait(60))
    assert refused.value.code == "DEADLINE_EXCEEDED"
    end.set()
    queue.close()
    with pytest.raises(RequestError, match="ends"):
        queue.answer("late", lambda: None)
