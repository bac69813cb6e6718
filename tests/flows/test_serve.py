"""`lidarpainter serve`: a run that simulators can call, until a signal ends it."""

import json
import re
import signal
import sys
import time

import cv2
import grpc
import numpy as np
import pytest
import torch
from commands import refuse, succeed
from served_process import serving
from tiny_street import FRONT, SCENE

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.serving import wire
from lidarpainter_models.serving.messages import camera_message, pose_message
from lidarpainter_models.serving.protos import common_pb2
from lidarpainter_models.serving.protos import sensorsim_pb2 as pb
from lidarpainter_models.serving.trust import KEYS

LONGEST_S = 2.0


@pytest.fixture(scope="module")
def server(tiny_run, tmp_path_factory):
    """The process of a server, where it listens, and its log."""
    log = tmp_path_factory.mktemp("serve") / "trust.csv"
    with serving(tiny_run, "--http-port", "0", "--log", log) as (process, addresses):
        yield process, addresses, log


def test_a_served_run_answers_as_render_and_ends_soon(tiny_run, server, tmp_path):
    process, (address, http_address), log = server
    out = tmp_path / "images"
    where = ("--trajectory", "recorded", "--camera", FRONT, "--frames", "2:3", "--out", out)
    succeed("render", tiny_run.run_id, *where, store=tiny_run.store)
    (image,) = json.loads((out / "trajectory.json").read_text("utf-8"))["images"]
    with grpc.insecure_channel(address) as channel:
        client = wire.client(channel)
        assert SCENE in client.get_available_scenes(common_pb2.Empty(), timeout=60).scene_ids
        reply, told = client.render_rgb.with_call(
            request_of(image, actors_of(tiny_run, image)), timeout=120
        )
    shown = cv2.imdecode(np.frombuffer(reply.image_bytes, np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(shown, cv2.imread(str(out / image["file"])))
    found = dict(told.trailing_metadata())
    assert float(found[KEYS[0]]) == pytest.approx(image["confidence"], abs=1e-4)
    assert float(found[KEYS[2]]) >= 0
    assert re.fullmatch(r"http://127.0.0.1:\d+", http_address)
    rows = log.read_text("utf-8").splitlines()
    assert rows[0].startswith("scene,camera")
    assert rows[1].startswith(f"{SCENE},{FRONT},")
    begun = time.monotonic()
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 143
    assert time.monotonic() - begun < LONGEST_S


def actors_of(tiny_run, image):
    """The actors as the run has them then."""
    from tasks.runs import open_run
    from tasks.stored import load_scene

    scene = load_scene(tiny_run.store, open_run(tiny_run.store, tiny_run.run_id).final.gaussians)
    poses, present = scene.actors.refined_poses(image["timestamp_ns"])
    tracks = zip(scene.actors.recorded_tracks, poses, present, strict=True)
    return [(track.actor_id, pose) for track, pose, is_there in tracks if is_there]


def request_of(image, actors):
    """A request of what `render` wrote about an image."""
    lens = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
    pose = torch.tensor(image["world_from_camera"], dtype=torch.float64).reshape(4, 4)
    camera = Camera(world_from_camera=pose, **{name: image[name] for name in lens})
    time_us = image["timestamp_ns"] // 1000
    return pb.RGBRenderRequest(
        scene_id=SCENE,
        camera_intrinsics=camera_message(FRONT, camera),
        frame_start_us=time_us,
        frame_end_us=time_us + 1,
        sensor_pose=pb.PosePair(start_pose=pose_message(pose)),
        dynamic_objects=[
            pb.DynamicObject(track_id=name, pose_pair=pb.PosePair(start_pose=pose_message(where)))
            for name, where in actors
        ],
    )


def test_a_missing_extra_is_one_line(tiny_run, monkeypatch):
    monkeypatch.setitem(sys.modules, "grpc", None)
    line = refuse("serve", tiny_run.run_id, "--port", "0", store=tiny_run.store)
    assert "lidarpainter[simulators]" in line


def test_a_port_that_is_taken_is_one_line(tiny_run):
    import socket

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        line = refuse("serve", tiny_run.run_id, "--port", port, store=tiny_run.store)
    assert port in line
