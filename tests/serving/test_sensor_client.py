"""The client of a renderer, against one that answers from a table: ours or somebody else's."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import cv2
import grpc
import numpy as np
import pytest
import torch

from lidarpainter_models.errors import DataError
from lidarpainter_models.serving import wire
from lidarpainter_models.serving.protos import common_pb2, sensorsim_pb2
from lidarpainter_models.serving.sensor_client import connected


class Renderer:
    """Answers cameras and batches; notes what it was asked."""

    def __init__(self, *, trust=None, size_px=(64, 36), quat_w=1.0, drops=False):
        self.trust, self.size_px, self.quat_w, self.drops = trust, size_px, quat_w, drops
        self.asked = []

    def __getattr__(self, name):
        def unknown(_message, context):
            context.abort(grpc.StatusCode.UNIMPLEMENTED, f"{name} is not here")

        return unknown

    def get_available_scenes(self, _message, _context):
        return common_pb2.AvailableScenesReturn(scene_ids=["street"])

    def get_available_cameras(self, _message, _context):
        reply = sensorsim_pb2.AvailableCamerasReturn()
        for name, x_m in (("front", 1.0), ("back", -1.0)):
            spec = sensorsim_pb2.CameraSpec(
                logical_id=name, resolution_w=self.size_px[0], resolution_h=self.size_px[1]
            )
            pose = common_pb2.Pose(
                vec=common_pb2.Vec3(x=x_m, z=1.5), quat=common_pb2.Quat(w=self.quat_w)
            )
            reply.available_cameras.add(intrinsics=spec, rig_to_camera=pose, logical_id=name)
        return reply

    def batch_render_rgb(self, message, context):
        self.asked.append(message)
        reply = sensorsim_pb2.BatchRGBRenderReturn()
        for number, item in enumerate(message.items[self.drops :]):
            size = (item.request.resolution_h, item.request.resolution_w, 3)
            png = cv2.imencode(".png", np.full(size, (10, 20, 30 + number), np.uint8))[1]
            reply.items.add(
                camera_name=item.camera_name,
                success=item.request.frame_start_us != 13,
                error_message="thirteen",
                result=sensorsim_pb2.RGBRenderReturn(image_bytes=png.tobytes()),
            )
        if self.trust is not None:
            context.set_trailing_metadata((("lidarpainter-confidence", self.trust),))
        return reply


@contextmanager
def at(renderer, wanted=("run", "street"), width_px=32):
    """A client of a renderer on a port of this machine."""
    server = grpc.server(ThreadPoolExecutor(2))
    server.add_generic_rpc_handlers(wire.handlers(renderer))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        with connected(f"127.0.0.1:{port}", wanted, width_px=width_px) as client:
            yield client
    finally:
        server.stop(None)


def test_cameras_are_asked_for_where_the_car_is_all_in_one_batch():
    renderer = Renderer(trust="0.9100,0.2000")
    rig = torch.eye(4, dtype=torch.float64)
    rig[:3, 3] = torch.tensor([10.0, 2.0, 0.5])
    with at(renderer) as client:
        actors = {"a": torch.eye(4, dtype=torch.float64)}
        found = client.frames(("front", "back"), rig, 1_000_000, actors)
    (batch,) = renderer.asked
    front, back = (item.request for item in batch.items)
    assert front.scene_id == "street"
    assert (front.resolution_w, front.resolution_h) == (32, 18)
    assert (front.frame_start_us, front.frame_end_us) == (1_000_000, 1_000_001)
    assert (front.sensor_pose.start_pose.vec.x, back.sensor_pose.start_pose.vec.x) == (11.0, 9.0)
    assert front.sensor_pose.start_pose.vec.z == 2.0
    assert [one.track_id for one in front.dynamic_objects] == ["a"]
    assert found["front"].rgb_u8.shape == (18, 32, 3)
    assert found["front"].rgb_u8[0, 0].tolist() == [30, 20, 10]  # RGB
    assert (found["front"].confidence, found["back"].confidence) == (0.91, 0.2)


def test_a_renderer_that_tells_nothing_of_trust_is_as_good():
    with at(Renderer()) as client:
        found = client.frames(("front",), torch.eye(4, dtype=torch.float64), 0, {})
    assert found["front"].confidence is None


def test_what_a_renderer_refuses_or_lacks_is_told_in_one_line():
    rig = torch.eye(4, dtype=torch.float64)
    with at(Renderer()) as client, pytest.raises(DataError, match="camera front: thirteen"):
        client.frames(("front",), rig, 13, {})
    with at(Renderer(drops=True)) as client, pytest.raises(DataError, match="1 images of 2"):
        client.frames(("front", "back"), rig, 0, {})
    for renderer in (Renderer(size_px=(0, 36)), Renderer(quat_w=0.0)):
        with (
            pytest.raises(DataError, match="'front': no seat in the car, or no size"),
            at(renderer),
        ):
            pass
    with (
        pytest.raises(DataError, match="has no scene run, it has street"),
        at(Renderer(), ("run",)),
    ):
        pass


def test_nobody_at_the_address_is_told_in_one_line(monkeypatch):
    monkeypatch.setattr("lidarpainter_models.serving.sensor_client.CONNECT_S", 0.3)
    with (
        pytest.raises(DataError, match=r"127\.0\.0\.1:1: "),
        connected("127.0.0.1:1", ("a",), width_px=32),
    ):
        pass
