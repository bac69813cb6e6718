"""Sweeps that a simulator asks for: true to the street, with the actors that it names."""

from dataclasses import replace

import grpc
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from served_street import placed_object, served

from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.serving import wire
from lidarpainter_models.serving.messages import pose_message
from lidarpainter_models.serving.protos import sensorsim_pb2 as pb
from lidarpainter_models.serving.refusals import RequestError
from lidarpainter_models.serving.served_sweeps import measured_points, read_sweep

FRAME = 2
TURN_US = 100_000


@pytest.fixture(scope="module")
def swept(street):
    """The served scene with what its LiDAR sees."""
    return replace(street.served, returns=street.returns)


@pytest.fixture(scope="module")
def sweep(street):
    return next(one for one in street.recording.sweeps if one.frame_index == FRAME)


def asked(street, sweep, *, actors=None, turn_us=TURN_US, **about):
    """A `LidarRenderRequest` for where the log's own LiDAR was; it stands still."""
    stand = pose_message(sweep.world_from_lidar)
    middle_us = sweep.timestamp_ns // 1000
    placed = street.actors_at(sweep.timestamp_ns) if actors is None else actors
    return pb.LidarRenderRequest(
        scene_id="street",
        lidar_config=pb.LidarSpec(**about),
        frame_start_us=middle_us - turn_us // 2,
        frame_end_us=middle_us + turn_us // 2,
        sensor_pose=pb.PosePair(start_pose=stand, end_pose=stand),
        dynamic_objects=placed,
    )


def world_of(sweep, points):
    return transform_points(sweep.world_from_lidar, points.xyz_m.double())


def test_points_lie_where_the_street_is(street, swept, sweep):
    points = measured_points(swept, read_sweep(asked(street, sweep)))
    recorded = street.recording.read_positions(FRAME)
    near = points.xyz_m[points.xyz_m.norm(dim=1) < 20]
    world = transform_points(sweep.world_from_lidar, near.double())
    apart_m = cKDTree(recorded.numpy()).query(world.numpy())[0]
    assert len(near) > 2000
    assert np.median(apart_m) < 0.3  # the recorded beams are coarse: that far lies the next one
    assert 0 <= points.intensity.min() < points.intensity.max() <= 1


def test_who_is_left_out_returns_nothing_and_who_is_moved_does_elsewhere(street, swept, sweep):
    tracks = street.scene.actors.recorded_tracks
    poses, present = street.scene.actors.refined_poses(sweep.timestamp_ns)

    def inside(points, pose, size_m):
        local = transform_points(invert_rigid(pose), world_of(sweep, points))
        return int((local.abs() < size_m.double() / 2 + 0.1).all(dim=1).sum())

    everybody = measured_points(swept, read_sweep(asked(street, sweep)))
    seen = [inside(everybody, pose, t.size_m) for t, pose in zip(tracks, poses, strict=True)]
    row = int(np.argmax(np.array(seen) * present.numpy()))
    assert seen[row] > 20
    nobody = measured_points(swept, read_sweep(asked(street, sweep, actors=[])))
    assert inside(nobody, poses[row], tracks[row].size_m) < seen[row] / 4
    moved = poses[row].clone()
    moved[2, 3] += 4.0  # into the air, where nothing else is
    alone = [placed_object(tracks[row].actor_id, moved)]
    there = measured_points(swept, read_sweep(asked(street, sweep, actors=alone)))
    assert inside(there, moved, tracks[row].size_m) > 5
    assert inside(nobody, moved, tracks[row].size_m) == 0


def test_points_are_told_in_the_frame_at_the_end_of_a_moving_sweep(street, swept, sweep):
    message = asked(street, sweep)
    still = measured_points(swept, read_sweep(message))
    ahead = sweep.world_from_lidar.clone()
    ahead[:3, 3] += sweep.world_from_lidar[:3, 0] * 0.5
    message.sensor_pose.end_pose.CopyFrom(pose_message(ahead))
    moving = measured_points(swept, read_sweep(message))
    one, other = world_of(sweep, still), transform_points(ahead, moving.xyz_m.double())
    apart_m = cKDTree(one.numpy()).query(other.numpy())[0]
    assert np.median(apart_m) < 0.3
    assert not torch.equal(still.xyz_m[:100], moving.xyz_m[:100])


def test_a_filter_leaves_out_what_it_says(street, swept, sweep):
    message = asked(street, sweep)
    whole = measured_points(swept, read_sweep(message))
    message.render_filter.enable_distance_filter = True
    message.render_filter.distance_filter_threshold = 10.0
    near = measured_points(swept, read_sweep(message))
    assert 0 < len(near.xyz_m) < len(whole.xyz_m)
    assert near.xyz_m.norm(dim=1).max() <= 10.0 + 1e-3
    message.render_filter.raydrop_threshold = 0.0
    assert len(measured_points(swept, read_sweep(message)).xyz_m) == 0


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"raydrop_threshold": float("nan")}, "raydrop_threshold nan"),
        ({"opacity_threshold": 2.0}, "opacity_threshold 2"),
        ({"distance_filter_threshold": -1.0}, "distance_filter_threshold -1"),
    ],
)
def test_a_filter_that_makes_no_sense_is_refused(street, sweep, changes, expected):
    message = asked(street, sweep)
    message.render_filter.enable_distance_filter = "distance_filter_threshold" in changes
    for name, value in changes.items():
        setattr(message.render_filter, name, value)
    with pytest.raises(RequestError, match=expected):
        read_sweep(message)


def test_a_sweep_over_the_wire_is_the_same_as_numbers_and_as_bytes(street, swept, sweep):
    class Swept:
        served, library = swept, street.library

    with served(Swept()) as channel:
        client = wire.client(channel)
        at128 = client.render_lidar(asked(street, sweep, lidar_type=pb.AT128), timeout=120)
        together = pb.AggregatedRenderRequest(
            lidar_requests=[asked(street, sweep, lidar_type=pb.AT128)]
        )
        again = client.render_aggregated(together, timeout=120)
    xyz_m = np.frombuffer(at128.point_xyzs_buffer, "<f4").reshape(-1, 3)
    assert len(xyz_m) == at128.num_points > 1000
    assert np.array_equal(xyz_m.ravel(), np.array(at128.point_xyzs, np.float32))
    assert again.lidar_returns[0] == at128
    azimuth_deg = np.degrees(np.arctan2(xyz_m[:, 1], xyz_m[:, 0]))
    assert np.abs(azimuth_deg).max() < 62  # it looks ahead


def test_a_server_without_lidar_says_so(street, client, sweep):
    with pytest.raises(grpc.RpcError) as raised:
        client.render_lidar(asked(street, sweep), timeout=60)
    assert raised.value.code() is grpc.StatusCode.FAILED_PRECONDITION
    assert "without --lidar" in raised.value.details()
