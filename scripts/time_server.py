"""Time what a renderer answers: the first image, one camera, all cameras at once, a larger image.

    python scripts/time_server.py HOST:PORT SCENE [--width 480] [--aside 1.0] [--frames 24]

Milliseconds of the clock from the call to the bytes (JPEG), asked for one after another: poses of
the recorded path, moved aside, everybody where they were. The first image is asked for at once, so
start the server anew to see what loading a scene takes; image and batch are told at the median.
"""

import argparse
import sys
import time
from collections.abc import Callable
from itertools import cycle, islice
from statistics import median
from typing import Any

import torch

from lidarpainter_models.serving.messages import matrix_of, pose_message
from lidarpainter_models.serving.protos import sensorsim_pb2 as messages
from lidarpainter_models.serving.sensor_client import CALL_S, SensorClient, connected

Asked = Callable[[int], Any]
"""What sends the request of one moment and waits for the reply."""
LARGE_PX = 1920


def main() -> None:
    """Ask, and print a line for each kind."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("address")
    parser.add_argument("scene")
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--aside", type=float, default=1.0)
    parser.add_argument("--frames", type=int, default=24)
    given = parser.parse_args()
    with connected(given.address, (given.scene,), width_px=given.width) as client:
        moments, beside = (_moments(client, given.aside + by_m) for by_m in (0.0, 0.1))
        names = tuple(client.cameras)
        first = names.index("front_camera") if "front_camera" in names else 0

        def asking(count: int, width_px: int, way: list[Any]) -> Asked:
            chosen = (names[first:] + names[:first])[:count]
            return lambda place: client.calls.batch_render_rgb(
                _batch(client, chosen, way[place % len(way)], width_px), timeout=CALL_S
            )

        one, large = asking(1, given.width, moments), asking(1, LARGE_PX, beside)
        together = f"{len(names)} cameras in one batch"
        _told("first image", [_milliseconds(one, 0)])
        for name, asked, count in (
            ("one camera", one, given.frames),
            ("one camera, again", asking(1, given.width, beside), given.frames),
            (together, asking(len(names), given.width, moments), given.frames),
            (f"{together}, again", asking(len(names), given.width, beside), given.frames),
            (f"one camera, {LARGE_PX} pixels wide", large, 6),
        ):
            asked(0)
            places = islice(cycle(range(1, len(moments))), count)
            _told(name, [_milliseconds(asked, place) for place in places])


def _moments(client: SensorClient, aside_m: float) -> list[tuple[int, torch.Tensor, list[Any]]]:
    """Times, poses of the car beside its path, and who was where then, of the recorded drive."""
    scene = client.scene_id
    ways = client.calls.get_available_trajectories(
        messages.AvailableTrajectoriesRequest(scene_id=scene), timeout=CALL_S
    )
    people = client.calls.get_dynamic_objects(
        messages.DynamicObjectsRequest(scene_id=scene), timeout=CALL_S
    )
    moments = []
    for pose in ways.available_trajectories[0].trajectory.poses:
        world_from_rig = matrix_of(pose.pose)
        world_from_rig[:3, 3] += aside_m * world_from_rig[:3, 1]
        moments.append((pose.timestamp_us, world_from_rig, _placed(people, pose.timestamp_us)))
    return moments


def _placed(people: Any, timestamp_us: int) -> list[Any]:  # noqa: ANN401 - a message
    """Everybody who is there at a time, at their nearest recorded pose."""
    placed = []
    for actor in people.dynamic_objects:
        poses = actor.trajectory.poses
        nearest = min(poses, key=lambda pose: abs(pose.timestamp_us - timestamp_us))
        if abs(nearest.timestamp_us - timestamp_us) < 100_000:
            pair = messages.PosePair(start_pose=nearest.pose, end_pose=nearest.pose)
            placed.append(messages.DynamicObject(track_id=actor.id, pose_pair=pair))
    return placed


def _batch(
    client: SensorClient,
    names: tuple[str, ...],
    moment: tuple[int, torch.Tensor, list[Any]],
    width_px: int,
) -> Any:  # noqa: ANN401 - a message
    """The request of some cameras at one moment."""
    timestamp_us, world_from_rig, actors = moment
    items = []
    for name in names:
        pose = pose_message(world_from_rig @ client.rig_from_camera[name])
        spec = client.cameras[name]
        request = messages.RGBRenderRequest(
            scene_id=client.scene_id,
            resolution_w=width_px,
            resolution_h=round(spec.resolution_h * width_px / spec.resolution_w),
            camera_intrinsics=spec,
            frame_start_us=timestamp_us,
            frame_end_us=timestamp_us + 1,
            sensor_pose=messages.PosePair(start_pose=pose, end_pose=pose),
            dynamic_objects=actors,
            image_format=messages.JPEG,
        )
        items.append(messages.BatchRGBRenderRequestItem(camera_name=name, request=request))
    return messages.BatchRGBRenderRequest(items=items)


def _milliseconds(asked: Asked, place: int) -> float:
    began_s = time.perf_counter()
    reply = asked(place)
    taken_ms = 1e3 * (time.perf_counter() - began_s)
    for item in reply.items:
        if not item.success:
            raise SystemExit(f"{item.camera_name}: {item.error_message}")
    return taken_ms


def _told(name: str, taken_ms: list[float]) -> None:
    slowest = f", at most {max(taken_ms):.0f} ms" if len(taken_ms) > 1 else ""
    sys.stdout.write(f"{name}: {median(taken_ms):.0f} ms{slowest}\n")


if __name__ == "__main__":
    main()
