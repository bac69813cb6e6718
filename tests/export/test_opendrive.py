"""The driven road as OpenDRIVE, evaluated by a reader that is not ours."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from bundle_reader import reference_line
from made_road import bent, height_m, road_surroundings

from lidarpainter_models.export.opendrive import opendrive

CURVATURE = 1 / 80


@pytest.fixture(scope="module")
def made():
    """The road, and its file as it is read again."""
    lines = {-5.25: True, -1.75: False, 1.75: True, 5.25: True}
    around = road_surroundings(lines, curvature_per_m=CURVATURE)
    content = opendrive(around.road, around.ground, "a/b", {"frame": "world"})
    return around.road, ET.fromstring(content)  # noqa: S314 - our own


def test_reference_line_is_where_traffic_against_us_begins(made):
    road, read = made
    line = reference_line(read)
    edge = next(lane.right_d_m for lane in road.lanes if not lane.is_forward)
    driven = (line[:, 0] > 42) & (line[:, 0] < 78)  # s counts from the end of what lies before
    sd = road.line.coordinates(line[driven, 1:3])
    np.testing.assert_allclose(sd[:, 1], edge, atol=0.01)
    expected = bent(sd[:, 0], edge, CURVATURE)
    np.testing.assert_allclose(line[driven, 1:3], expected, atol=0.08)


def test_pieces_follow_each_other_without_a_step(made):
    line = reference_line(made[1])
    steps = np.linalg.norm(np.diff(line[:, 1:3], axis=0), axis=1)
    assert steps.max() < 0.35
    np.testing.assert_allclose(steps.sum(), float(made[1].find("road").get("length")), rtol=1e-3)


def test_road_is_as_high_as_the_ground(made):
    road, read = made
    line = reference_line(read)
    inside = (line[:, 0] > 42) & (line[:, 0] < 78)
    s, d = road.line.coordinates(line[inside, 1:3]).T
    np.testing.assert_allclose(line[inside, 3], height_m(s, d), atol=0.04)


def test_lanes_are_numbered_from_the_reference_line_with_their_widths(made):
    road, read = made
    section = read.find("road/lanes/laneSection")
    widths = {
        int(lane.get("id")): float(lane.find("width").get("a"))
        for side in ("left", "right")
        for lane in section.find(side)
    }
    forward = [lane for lane in road.lanes if lane.is_forward]
    assert sorted(widths) == [-2, -1, 1]
    assert widths[-1] == pytest.approx(forward[-1].left_d_m - forward[-1].right_d_m)
    marks = {int(one.get("id")): one.find("roadMark").get("type") for one in section.iter("lane")}
    assert (marks[0], marks[-1], marks[-2]) == ("solid", "broken", "solid")
    assumed = [one.get("value") for one in section.iter("userData")]
    assert assumed == ["nobody showed its direction"] * len(assumed)
    assert read.find("header/userData").get("code") == "frame"
