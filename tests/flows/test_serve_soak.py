"""Eight clients of one server, mixed and partly malformed, for LIDARPAINTER_SOAK_S seconds."""

import os
import random
import signal
import time
from concurrent.futures import ThreadPoolExecutor

import grpc
import psutil
import pytest
from served_process import serving
from spoilt_messages import lenses, spoilt
from tiny_street import SCENE

from lidarpainter_models.serving import wire
from lidarpainter_models.serving.messages import matrix_of, pose_message
from lidarpainter_models.serving.protos import common_pb2
from lidarpainter_models.serving.protos import sensorsim_pb2 as pb

SECONDS = float(os.environ.get("LIDARPAINTER_SOAK_S", "20"))
CLIENTS, SPOILT_SHARE, TIMEOUT_S = 8, 0.4, 300.0
WARM_SHARE = 0.3
"""Of the time after which memory is looked at first: lenses and recorded moments are known then."""
MOST_GROWTH = 1.05
LONGEST_END_S = 2.0
REFUSALS = {
    *("NOT_FOUND", "INVALID_ARGUMENT", "OUT_OF_RANGE", "FAILED_PRECONDITION"),
    *("RESOURCE_EXHAUSTED", "DEADLINE_EXCEEDED"),
}


def good_requests(client):
    """Calls that are answered: images of every camera, time and lens, batches, what is known."""
    known = {"scene_id": SCENE}
    cameras = client.get_available_cameras(pb.AvailableCamerasRequest(**known)).available_cameras
    ways = client.get_available_trajectories(pb.AvailableTrajectoriesRequest(**known))
    poses = ways.available_trajectories[0].trajectory.poses
    found, images = [], []
    for number, camera in enumerate(cameras):
        specs = [camera.intrinsics, *lenses(camera.intrinsics).values()]
        for place, spec in zip(poses, specs, strict=False):
            stand = pose_message(matrix_of(place.pose) @ matrix_of(camera.rig_to_camera))
            images.append(
                pb.RGBRenderRequest(
                    camera_intrinsics=spec,
                    resolution_w=min(spec.resolution_w, 192),
                    frame_start_us=place.timestamp_us,
                    frame_end_us=place.timestamp_us + 1,
                    sensor_pose=pb.PosePair(start_pose=stand, end_pose=stand),
                    image_format=pb.PNG if number else pb.JPEG,
                    **known,
                )
            )
    found += [("render_rgb", image) for image in images]
    items = [pb.BatchRGBRenderRequestItem(camera_name="a", request=one) for one in images[::4]]
    found.append(("batch_render_rgb", pb.BatchRGBRenderRequest(items=items)))
    found.append(("render_aggregated", pb.AggregatedRenderRequest(rgb_requests=images[:2])))
    found.append(("get_dynamic_objects", pb.DynamicObjectsRequest(**known)))
    return [*found, ("get_available_scenes", common_pb2.Empty())]


def answer(client, name, message):
    """All that is answered: the reply's bytes and what is said of its trust."""
    reply, call = getattr(client, name).with_call(message, timeout=TIMEOUT_S)
    told = {key: value for key, value in call.trailing_metadata() if key.startswith("lidarpainter")}
    return reply.SerializeToString(deterministic=True), told


def ask(address, seed, until, requests, expected):
    """One client: how many requests were answered as alone, and how many were refused."""
    dice, counts = random.Random(seed), [0, 0]  # noqa: S311
    with grpc.insecure_channel(address) as channel:
        client = wire.client(channel)
        while time.monotonic() < until:
            number = dice.randrange(len(requests))
            name, message = requests[number]
            if dice.random() < SPOILT_SHARE:
                call = getattr(client, name).future(
                    spoilt(message, dice.random()), timeout=TIMEOUT_S
                )
                if refused := call.exception():
                    assert refused.code().name in REFUSALS, (refused.code(), refused.details())
                    assert refused.details().isprintable()
                counts[1] += refused is not None
            else:
                assert answer(client, name, message) == expected[number], name
                counts[0] += 1
    return counts


@pytest.mark.slow
def test_eight_clients_get_what_one_gets_and_the_server_does_not_grow(tiny_run):
    words = ("--time-limit", "300s", "--placeholder", "--parked-apart")
    with serving(tiny_run, *words) as (process, (address,)):
        with grpc.insecure_channel(address) as channel:
            client = wire.client(channel)
            requests = good_requests(client)
            expected = [answer(client, *one) for one in requests]
        until = time.monotonic() + SECONDS
        with ThreadPoolExecutor(CLIENTS) as pool:
            asking = [
                pool.submit(ask, address, seed, until, requests, expected)
                for seed in range(CLIENTS)
            ]
            time.sleep(WARM_SHARE * SECONDS)
            first = psutil.Process(process.pid).memory_info().rss
            counts = [one.result() for one in asking]
        last = psutil.Process(process.pid).memory_info().rss
        answered, refused = map(sum, zip(*counts, strict=True))
        print(f"{answered} answered, {refused} refused, {first / 1e6:.0f} to {last / 1e6:.0f} MB")  # noqa: T201
        assert answered > CLIENTS
        assert refused > 0
        assert last < MOST_GROWTH * first
        end_in_time(process, address, requests)


def end_in_time(process, address, requests):
    """A signal ends it while requests run, which are answered or refused."""
    with grpc.insecure_channel(address) as channel:
        client = wire.client(channel)
        calls = [getattr(client, name).future(one) for name, one in requests[:CLIENTS]]
        time.sleep(0.05)
        begun = time.monotonic()
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 143
        assert time.monotonic() - begun < LONGEST_END_S
        for call in calls:
            if refused := call.exception(timeout=10):
                assert refused.code().name in ("UNAVAILABLE", "CANCELLED")
