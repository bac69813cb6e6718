"""Held-out views as pairs: which are left out, and where a street is looked at from."""

import pytest
import torch

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.evaluation.held_back import held_out_pairs, target_view, unseen_views
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.view_scores import ScoredView
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.painter.protocol import PaintingConditions
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.synthetic.street import SyntheticStreet

SHIFTS = (Shift(lateral_m=2.0), Shift(up_m=1.5))
LENS = {"fx_px": 6.0, "fy_px": 6.0, "cx_px": 3.0, "cy_px": 2.0}
CAMERA = Camera(
    world_from_camera=torch.eye(4, dtype=torch.float64), width_px=6, height_px=4, **LENS
)


def view(frame, camera="front"):
    return RecordedView(
        frame_index=frame, camera_name=camera, timestamp_ns=10 * frame, camera=CAMERA, index=frame
    )


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        ('log/1 [3, "front"]', ("log/1", 3, "front")),
        ('synthetic/street-1000 [3, "front", "left-2m"]', ("synthetic/street-1000", 3, "front")),
        ("log/1 some-pair", None),
        ('log/1 ["front", 3]', None),
    ],
)
def test_a_target_tells_its_view(target, expected):
    assert target_view(target) == expected


def test_views_that_a_painter_learnt_from_any_place_do_not_judge():
    trained = {'log/1 [0, "front"]', 'log/1 [1, "front", "left-2m"]', 'log/2 [2, "front"]', "x"}
    views = [view(0), view(0, "rear"), view(1), view(2)]
    unseen = unseen_views(views, "log/1", trained)
    assert [(one.frame_index, one.camera_name) for one in unseen] == [(0, "rear"), (2, "front")]


class GreyBuilder(ConditionBuilder):
    """Shows a grey render, and remembers what was asked for."""

    def __init__(self):
        self.scene = "fitted"
        self.asked = []

    def conditions(self, _camera, timestamp_ns, *, camera_name):
        self.asked.append((timestamp_ns, camera_name))
        grey, nowhere = torch.full((4, 6, 3), 0.5), torch.zeros(4, 6, dtype=torch.bool)
        return PaintingConditions(
            render_rgb=grey,
            render_depth_m=torch.ones(4, 6),
            render_alpha=torch.ones(4, 6),
            lidar_rgb=grey,
            lidar_depth_m=torch.zeros(4, 6),
            lidar_hit=nowhere,
            warp_rgb=grey[None],
            warp_valid=nowhere[None],
        )


@pytest.fixture
def places(monkeypatch):
    """Where images were looked for; those found are brighter than white, as drawn ones may be."""
    looked = []

    def found(held_out, *place):
        looked.append(place)
        return [
            ScoredView(
                name="found",
                camera=CAMERA,
                timestamp_ns=one.timestamp_ns,
                truth_rgb=torch.full((4, 6, 3), 1.5),
                actor_ids=(),
                actor_index=torch.full((4, 6), -1),
            )
            for one in held_out.test_views
        ]

    monkeypatch.setattr(HeldOut, "recorded_views", found)
    monkeypatch.setattr(HeldOut, "synthetic_views", found)
    return looked


def held_out():
    scene = object.__new__(DrivingScene)  # nothing of it is read here
    views = [view(4), view(5, "rear")]
    return HeldOut(scene=scene, test_views=views, observation=ObservationConfig())


def test_a_log_judges_at_its_held_out_images(places):
    builder = GreyBuilder()
    (pairs,) = held_out_pairs(builder, held_out(), None, SHIFTS).values()
    assert len(pairs) == 2
    pair = pairs.read(1)
    assert places == [("fitted", "interpolated")]
    assert builder.asked == [(50, "rear")]
    assert float(pair.target_rgb.max()) == 1
    assert bool(pair.target_valid.all())


def test_a_street_judges_beside_the_path(places):
    builder, street = GreyBuilder(), object.__new__(SyntheticStreet)
    found = held_out_pairs(builder, held_out(), street, SHIFTS)
    assert list(found) == ["left-2m", "up-1.5m"]
    found["up-1.5m"].read(0)
    assert places == [("fitted", street, SHIFTS[1])]
    assert builder.asked == [(40, "front")]
