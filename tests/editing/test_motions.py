"""Other ways and times for an actor; the road rises by one metre in twenty."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import FRAME_NS, car_track

from lidarpainter_models.editing.motions import AFTER_NS, LogTimes, rerouted, retimed, stopped
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from lidarpainter_models.lidar.ground_heights import GroundHeights
from lidarpainter_models.scenes.actor_names import path_of_track

NUM_FRAMES = 8
GRADE = 0.05
ABOVE_M = 0.6
"""Of a car's middle over the road."""


def car_on_slope():
    """Drives up, to +y."""
    track = car_track(NUM_FRAMES)
    poses = track.world_from_box.clone()
    poses[:, 2, 3] = ABOVE_M + GRADE * poses[:, 1, 3]
    return replace(track, world_from_box=poses)


@pytest.fixture(scope="module")
def slope():
    xy = torch.cartesian_prod(torch.arange(-10, 22, 0.25), torch.arange(-30, 40, 0.25))
    return GroundHeights(torch.cat([xy, GRADE * xy[:, 1:]], dim=1))


@pytest.fixture(scope="module")
def log():
    poses = torch.eye(4, dtype=torch.float64).repeat(NUM_FRAMES, 1, 1)
    times_ns = torch.arange(NUM_FRAMES) * FRAME_NS
    return LogTimes(ego=DrivenPath(timestamps_ns=times_ns, world_from_body=poses))


def above_m(track, spec, log, ground):
    """How high an actor on another way is over the road, at every moment."""
    ahead = car_on_slope()
    ahead.world_from_box[:, 1, 3] += 15
    way = parse_trajectory(spec, max_shift_m=None)
    moved = rerouted(track, way, log, ground, lambda _: path_of_track(ahead))
    return moved.world_from_box[:, 2, 3] - GRADE * moved.world_from_box[:, 1, 3]


@pytest.mark.parametrize(
    ("spec", "lifted_m"),
    [
        ("along:10", 0),
        ("along:-4", 0),
        ("along:4+up:2", 2),
        ("lateral:3", 0),
        ("yaw:90", 0),
        ("follow:ahead", 0),
    ],
)
def test_who_is_moved_stays_on_a_road_that_rises(slope, log, spec, lifted_m):
    found_m = above_m(car_on_slope(), spec, log, slope)
    expected = torch.full_like(found_m, ABOVE_M + lifted_m)
    torch.testing.assert_close(found_m, expected, rtol=0, atol=0.03)  # a cell's height is its own


@pytest.mark.parametrize("with_height", [False, True])
def test_waypoints_lead_over_the_road_or_as_high_as_they_say(slope, log, tmp_path, with_height):
    y_m = (-2, 8, 18)
    rows = [f"8,{y},{5 + GRADE * y}" if with_height else f"8,{y}" for y in y_m]
    file = tmp_path / "way.csv"
    file.write_text("\n".join(["x_m,y_m,z_m" if with_height else "x_m,y_m", *rows]))
    found_m = above_m(car_on_slope(), f"waypoints:{file}", log, slope)
    expected = torch.full_like(found_m, 5.0 if with_height else ABOVE_M)
    torch.testing.assert_close(found_m, expected, rtol=0, atol=0.03)


def test_a_roof_beside_the_way_is_not_climbed(log):
    xy = torch.cartesian_prod(torch.arange(-10, 22, 0.25), torch.arange(-30, 40, 0.25))
    roof_m = 3.0 * (xy[:, :1] > 8)
    ground = GroundHeights(torch.cat([xy, GRADE * xy[:, 1:] + roof_m], dim=1))
    found_m = above_m(car_on_slope(), "lateral:-6", log, ground)
    assert float((found_m - ABOVE_M).abs().max()) < 0.03


def brief(first, last):
    """There in some frames of the log alone."""
    track, some = car_track(NUM_FRAMES), slice(first, last + 1)
    return replace(
        track,
        frame_indices=track.frame_indices[some],
        timestamps_ns=track.timestamps_ns[some],
        world_from_box=track.world_from_box[some],
        num_points=track.num_points[some],
    )


def test_who_stands_before_it_was_last_seen_stays(log):
    track = stopped(brief(1, 4), 2 * FRAME_NS, log, over_s=0.1)
    assert track.is_present(log.end_ns + AFTER_NS)
    assert float(track.pose_at(log.end_ns)[1, 3]) == pytest.approx(0.5)  # braked over half a metre
    for at_ns in (4 * FRAME_NS, 6 * FRAME_NS):  # it has gone before it stands
        assert not stopped(brief(1, 4), at_ns, log, over_s=0.1).is_present(6 * FRAME_NS)


@pytest.mark.parametrize(("speed", "last"), [(0.5, 7), (2.0, 4)])
def test_who_is_slower_or_faster_comes_when_it_came(log, speed, last):
    track = retimed(brief(3, 5), log, delay_s=0, speed=speed)
    assert track.timestamps_ns[[0, -1]].tolist() == [3 * FRAME_NS, last * FRAME_NS]


def test_who_stands_is_not_moved_in_time(log):
    parked = replace(brief(0, 1), world_from_box=car_track(1).world_from_box.expand(2, 4, 4))
    assert retimed(parked, log, delay_s=5, speed=0.5) is parked


@pytest.mark.parametrize("delay_s", [-0.6, 0.5])
def test_who_would_not_be_there_at_all_is_refused(log, delay_s):
    with pytest.raises(ConfigError, match=r"'car' would be there from .* the log's 0 to 0\.7 s"):
        retimed(brief(3, 5), log, delay_s=delay_s, speed=1)
