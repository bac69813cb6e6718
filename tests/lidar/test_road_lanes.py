"""Lanes by their markings, their directions by who drives there, and what is assumed without."""

import numpy as np
import pytest
import torch
from made_road import LENGTH_M, STEP_NS, bent, moving_track, road_path, road_surroundings

from lidarpainter_models.lidar.ground_surface import ground_surface
from lidarpainter_models.lidar.road_lanes import driven_line, driven_road_lanes


@pytest.mark.parametrize("curvature_per_m", [0.0, 1 / 90])
def test_lines_of_paint_enclose_lanes(curvature_per_m):
    lines = {-1.75: True, 1.75: False, 5.25: True}
    road = road_surroundings(lines, curvature_per_m=curvature_per_m).road
    assert len(road.lanes) == 2
    assert road.own == 0
    assert [road.lane.right_d_m, road.lane.left_d_m] == pytest.approx([-1.75, 1.75], abs=0.12)
    assert (road.lane.right_mark, road.lane.left_mark) == ("solid", "broken")
    assert road.lanes[1].left_d_m == pytest.approx(5.25, abs=0.12)
    assert road.lane.assumed == ""


def test_who_comes_towards_us_tells_which_lanes_are_theirs():
    times_ns = torch.arange(0, 40, 4) * STEP_NS
    towards = moving_track("a", np.linspace(40, 5, 10), 3.5, times_ns=times_ns, yaw_rad=np.pi)
    along = moving_track("b", np.linspace(5, 40, 10), 3.5, times_ns=times_ns)
    lines = {-1.75: True, 1.75: False, 5.25: True}
    assert not road_surroundings(lines, tracks=[towards]).road.lanes[1].is_forward
    assert road_surroundings(lines, tracks=[along]).road.lanes[1].is_forward
    # nobody shows it: behind a solid line others come towards us
    alone = road_surroundings({-1.75: False, 1.75: True, 5.25: True}).road
    assert not alone.lanes[1].is_forward
    assert "direction" in alone.lanes[1].assumed


def test_one_line_gives_a_lane_of_usual_width_and_says_so():
    road = road_surroundings({1.6: True}).road
    assert road.lane.left_d_m - road.lane.right_d_m == pytest.approx(3.5)
    assert road.lane.left_d_m == pytest.approx(1.6, abs=0.12)
    assert "3.5 m" in road.lane.assumed


def test_without_paint_the_lane_is_assumed_and_level_ground_beside_it_is_as_far_as_trusted():
    around = road_surroundings()
    road = driven_road_lanes(
        around.road.line,
        np.zeros((0, 2)),
        around.ground,
        (),
        path_length_m=LENGTH_M,
        trusted_m=(2.0, 6.0),
    )
    right, own, left = road.lanes
    assert (own.right_d_m, own.left_d_m) == (-1.75, 1.75)
    assert left.left_d_m == pytest.approx(3.75)
    assert right.right_d_m == pytest.approx(-5.0, abs=0.3)  # the kerb
    assert (right.is_driving, own.is_driving, left.is_driving) == (False, True, False)
    assert all(lane.assumed for lane in road.lanes)


def test_road_coordinates_and_places_undo_each_other():
    line = road_surroundings(curvature_per_m=1 / 60).road.line
    s_m, d_m = np.meshgrid(np.linspace(2, LENGTH_M - 2, 15), np.linspace(-6, 6, 5))
    sd = np.stack([s_m.ravel(), d_m.ravel()], axis=1)
    found = line.coordinates(line.place(sd[:, 0], sd[:, 1]))
    np.testing.assert_allclose(found, sd, atol=0.03)
    np.testing.assert_allclose(
        line.place(sd[:, 0], sd[:, 1]), bent(sd[:, 0], sd[:, 1], 1 / 60), atol=0.08
    )


def test_the_line_goes_on_past_the_path_while_there_is_ground():
    line = road_surroundings().road.line
    assert line.s_m[0] == pytest.approx(-40, abs=0.6)
    assert line.s_m[-1] == pytest.approx(LENGTH_M + 40, abs=1.0)


def test_a_car_that_stands_has_a_road_too():
    path = road_path()
    still = type(path)(
        timestamps_ns=path.timestamps_ns[:5],
        world_from_body=path.world_from_body[:1].repeat(5, 1, 1),
    )
    around = road_surroundings()
    line = driven_line(still, around.ground)
    assert line.s_m[-1] > 30
    np.testing.assert_allclose(line.ahead, [[1.0, 0.0]] * len(line.xy_m), atol=1e-6)
    assert ground_surface(around.street, still).at(np.array([[0.0, 0.0]]))[0] == pytest.approx(
        0.0, abs=0.03
    )
