"""How far a stretch can be trusted is the last step before the first bad frame or wall."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import torch
from confidence_trials import FARTHEST
from gaussian_world import map_points
from toy_street import ToyStreet

from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer, ViewEvidence
from lidarpainter_models.evaluation.envelope import (
    DIRECTIONS,
    MovedViews,
    stretches_of,
    trust_envelope,
)
from lidarpainter_models.evaluation.score_tables import (
    TRUSTED,
    least_of,
    metric_values,
    values_by_view,
)
from lidarpainter_models.evaluation.view_confidence import GOOD_DB, Calibration
from lidarpainter_models.lidar.lidar_map import LidarMap
from lidarpainter_models.lidar.points_on_actors import MovingBoxes
from lidarpainter_models.observations.settings import ObservationConfig

NONE = dict.fromkeys(ViewEvidence.__dataclass_fields__, 0.0)
SURE = Calibration(
    intercept_db=0.0, weights={"expected_db": 1.0}, offset_db=0.0, spread_db=1e-3, record="sure"
)


class DrivenStreet(ToyStreet):
    """The toy street, driven through at 5 m a frame."""

    def __init__(self, num_frames=9):
        super().__init__(num_frames)
        self.frame_timestamps_ns = torch.arange(num_frames) * 100_000_000
        self.world_from_ego = self.world_from_ego.clone()
        self.world_from_ego[:, 0, 3] = 5.0 * torch.arange(num_frames)
        self.views = tuple(replace_pose(view, 5.0 * view.frame_index) for view in self.views)

    def views_of(self, camera_name):
        return tuple(view for view in self.views if view.camera_name == camera_name)

    def frame_position(self, frame_index):
        return frame_index


def replace_pose(view, x_m):
    pose = view.camera.world_from_camera.clone()
    pose[0, 3] = x_m
    return replace(view, camera=view.camera.at(pose))


class FadingEvidence(EvidenceGatherer):
    """A frame is good up to 2.5 m and 25 degrees off the path, and 6 m past its end."""

    def __init__(self, street, *, worst_frame=None, wall=None):
        self._street, self._worst = street, worst_frame
        points = torch.zeros(0, 3) if wall is None else wall.repeat(50, 1)
        self.builder = SimpleNamespace(
            lidar_map=LidarMap(street=map_points(points, torch.ones_like(points)), actors={}),
            boxes=MovingBoxes([]),
        )
        self.scene = SimpleNamespace(
            refined_camera=lambda _view, camera: camera, device=torch.device("cpu")
        )

    def of(self, camera, timestamp_ns, _camera_name=None):
        frame = round(timestamp_ns / 1e8)
        recorded = self._street.views[frame].camera
        away_m = camera.centre_world - recorded.centre_world
        axis, straight = camera.world_from_camera[:3, 2], recorded.world_from_camera[:3, 2]
        turned_deg = math.degrees(math.acos(min(float(axis @ straight), 1.0)))
        end_m = float(self._street.world_from_ego[-1, 0, 3])
        past_m = max(float(camera.centre_world[0]) - end_m, 0.0)
        is_bad = float(away_m[1:].norm()) > 2.5 or turned_deg > 25 or past_m > 6.5
        is_bad = is_bad or frame == self._worst
        return ViewEvidence(**(NONE | {"expected_db": GOOD_DB + (-1 if is_bad else 1)}))


def envelope_of(street, **changes):
    views = MovedViews(
        scene=street,
        gatherer=FadingEvidence(street, **changes),
        observation=ObservationConfig(width_px=240),
    )
    return trust_envelope(views, ["front"], SURE)


def test_the_path_is_cut_into_equal_stretches():
    found = stretches_of(DrivenStreet(9))
    assert [(one.from_m, one.to_m) for one in found] == [(0, 20), (20, 40)]
    assert [(one.first_frame, one.last_frame) for one in found] == [(0, 3), (4, 8)]


def test_a_car_that_stands_has_one_stretch():
    street = DrivenStreet(3)
    street.world_from_ego[:, 0, 3] = 0
    (only,) = stretches_of(street)
    assert (only.from_m, only.to_m, only.first_frame, only.last_frame) == (0, 0, 0, 2)


def test_a_walk_ends_at_the_last_good_step():
    found = envelope_of(DrivenStreet())
    first, last = found["stretches"]
    aside = {"left_m": 2.0, "right_m": 2.0, "up_m": 2.0, "yaw_left_deg": 20, "yaw_right_deg": 20}
    assert first == first | aside | {"ahead_m": 8.0}
    assert last == last | aside | {"ahead_m": 6.0}
    assert json.loads(json.dumps(found)) == found
    every_step = sum(len(levels) for levels, _step_of in DIRECTIONS.values())
    assert 0 < found["num_frames"] < 2 * 2 * (1 + every_step)  # both ends of both stretches


def test_nothing_is_promised_farther_out_than_it_was_calibrated():
    names = {"lateral_m": "aside", "up_m": "up", "along_m": "ahead", "yaw_rad": "yaw"}
    for levels, step_of in DIRECTIONS.values():
        step = step_of(levels[-1])
        (name,) = (name for name in names if getattr(step, name))
        assert levels[-1] <= FARTHEST[names[name]]


def test_a_place_in_a_wall_ends_a_walk_as_a_bad_frame_does():
    for first_x_m in (0.0, 15.0):  # at the first and at the last moment of a stretch
        wall = torch.tensor([[first_x_m, 1.0, 1.7]])
        found = envelope_of(DrivenStreet(), wall=wall)
        assert [row["left_m"] for row in found["stretches"]] == [0.0, 2.0]
        assert [row["right_m"] for row in found["stretches"]] == [2.0, 2.0]


def test_a_stretch_that_is_bad_where_it_was_driven_has_no_figures():
    found = envelope_of(DrivenStreet(), worst_frame=8)
    assert all(found["stretches"][1][name] is None for name in TRUSTED)
    assert found["stretches"][0]["left_m"] == 2.0
    assert set(least_of(found).values()) == {None}


def test_the_catalog_has_the_least_and_every_stretch():
    scores = {"recorded": {}, "novel": {}, "envelope": envelope_of(DrivenStreet())}
    rows = {row[:3]: row[3:] for row in metric_values(scores)}
    assert rows["envelope", "ahead", "trusted_m"] == (6.0, None)
    assert rows["envelope", "yaw-left", "trusted_deg"] == (20, None)
    by_stretch = values_by_view(scores)["envelope", "ahead", "trusted_m"]
    assert by_stretch == {"0-20m": 8.0, "20-40m": 6.0}


def test_every_direction_is_told_of():
    assert tuple(DIRECTIONS) == TRUSTED
