"""Pairs from weak fits: what they are judged at, and what must never leak into them."""

from dataclasses import replace

import cv2
import pytest
import torch

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import ImageRecord, SweepPoints
from lidarpainter_models.scenes.splits import split_views
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter
from lidarpainter_models.training_data.harvest import (
    LeftOutPlan,
    check_plan,
    default_plans,
    harvest_left_out,
)
from lidarpainter_models.training_data.pairs import PairFolder, PairWriter
from lidarpainter_models.training_data.settings import AS_GIVEN, HarvestConfig, StreetPlan, weak_fit
from lidarpainter_models.training_data.street_harvest import draw_shift, harvest_shifted_street

TINY_FIT = replace(weak_fit(4, budget=400), initialisation=InitialisationConfig(num_gaussians=300))
TINY = HarvestConfig(
    observations=ObservationConfig(width_px=64),
    reference_fit=replace(TINY_FIT, refinement=AS_GIVEN),
)


def untold(_done, _total):
    pass


PLAN = LeftOutPlan(fit_frames=(0, 4), target_frames=(2,), fit=TINY_FIT, with_all_sweeps=True)


@pytest.fixture
def write_wall(tmp_path, camera_at, board, draw):
    """Records a drive towards a wall with a board before it; some images may be blackened."""
    boards = [board(x_m=14.0, top_m=8.0), board(x_m=9.0, left_m=2.0, right_m=-1.0, top_m=3.0)]
    still = torch.eye(4, dtype=torch.float64)

    def write(name, black_frames=()):
        header = SceneHeader(licence="made here", global_from_world=still)
        with SceneWriter(tmp_path, "tests", name, header) as writer:
            for frame in range(6):
                time_ns = 100_000_000 * frame
                camera = camera_at(x_m=0.3 * frame)
                rgb, depth_m = draw(camera, boards)
                points = camera.unproject(depth_m)[depth_m > 0]
                if frame in black_frames:
                    rgb = torch.zeros_like(rgb)
                bgr = (255 * rgb.flip(-1)).round().to(torch.uint8).numpy()
                jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
                pose = still.clone()
                pose[0, 3] = 0.3 * frame
                writer.add_frame(frame, timestamp_ns=time_ns, world_from_ego=pose)
                record = ImageRecord(camera_name="front", timestamp_ns=time_ns, camera=camera)
                writer.add_image(record, jpeg)
                writer.add_sweep(
                    "roof",
                    _points(points),
                    timestamp_ns=time_ns,
                    world_from_lidar=camera.world_from_camera,
                )
        return DrivingScene.open(tmp_path / "scenes" / "tests" / name)

    return write


def _points(xyz_m):
    count = len(xyz_m)
    return SweepPoints(
        xyz_m=xyz_m,
        intensity=torch.ones(count),
        time_offset_ns=torch.zeros(count, dtype=torch.int32),
        ring=torch.zeros(count, dtype=torch.int16),
        return_index=torch.zeros(count, dtype=torch.uint8),
        lidar=torch.zeros(count, dtype=torch.uint8),
    )


@pytest.mark.slow
def test_left_out_views_become_pairs_once(write_wall, tmp_path):
    scene = write_wall("wall")
    split = split_views(scene, "alternate")
    told = []
    folder = tmp_path / "pairs"

    def harvest():
        return harvest_left_out(
            scene,
            split,
            [PLAN],
            PairWriter(folder),
            config=TINY,
            progress=lambda done, total: told.append((done, total)),
        )

    assert harvest() == 2
    assert told == [(1, 1)]
    assert harvest() == 0, "everything is there already"
    pairs = PairFolder(folder)
    as_fitted, damaged = (pairs.provenance(index) for index in range(2))
    assert as_fitted["target"] == [2, "front"]
    assert as_fitted["fit_frames"] == [0, 4]
    assert as_fitted["corruption_seed"] is None
    assert damaged["corruption_seed"] is not None
    pair = pairs.read(0)
    recorded = scene.read_image(split.train[1]).float() / 255
    torch.testing.assert_close(pair.target_rgb, recorded, rtol=0, atol=0.51 / 255)
    assert bool(pair.conditions.lidar_hit.any())
    assert bool(pair.conditions.warp_valid.any())


@pytest.mark.slow
def test_the_true_image_never_reaches_the_conditions(write_wall, tmp_path):
    pairs = {}
    for name, black in (("wall", ()), ("dark", (2,))):
        scene = write_wall(name, black)
        split = split_views(scene, "alternate")
        writer = PairWriter(tmp_path / name)
        harvest_left_out(scene, split, [PLAN], writer, config=TINY, progress=untold)
        pairs[name] = PairFolder(tmp_path / name).read(0)
    assert float(pairs["dark"].target_rgb.max()) < 0.02
    for field in ("render_rgb", "render_depth_m", "lidar_rgb", "lidar_hit", "warp_rgb"):
        light, dark = (getattr(pair.conditions, field) for pair in pairs.values())
        assert torch.equal(light, dark), field


@pytest.mark.parametrize(
    ("fit_frames", "target_frames", "message"),
    [
        ((0, 2), (3,), r"training frames only, not \[3\]"),
        ((0, 1), (2,), r"not \[1\]"),
        ((0, 2), (2, 4), "other frames to judge"),
        ((), (2,), "other frames to judge"),
        ((0,), (), "other frames to judge"),
    ],
)
def test_test_frames_and_circles_are_refused(write_wall, fit_frames, target_frames, message):
    split = split_views(write_wall("wall"), "alternate")
    plan = LeftOutPlan(fit_frames=fit_frames, target_frames=target_frames)
    with pytest.raises(ConfigError, match=message) as caught:
        check_plan(plan, split)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("num_frames", [2, 3, 9, 14])
def test_default_plans_judge_every_frame_and_never_what_they_fit(num_frames):
    frames = tuple(range(0, 2 * num_frames, 2))
    plans = default_plans(frames)
    for plan in plans:
        assert not set(plan.fit_frames) & set(plan.target_frames)
    judged = {frame for plan in plans for frame in plan.target_frames}
    assert judged == set(frames)


def test_drawn_shifts_lie_in_their_ranges_on_both_sides():
    generator = torch.Generator().manual_seed(0)
    shifts = [draw_shift(generator) for _ in range(300)]
    sideways = [shift.lateral_m for shift in shifts if shift.lateral_m]
    assert 0.6 < len(sideways) / 300 < 0.8
    assert all(1.0 <= abs(lateral_m) <= 3.5 for lateral_m in sideways)
    assert min(sideways) < -3 < 3 < max(sideways)
    assert all(shift.up_m == 0 or 0.5 <= shift.up_m <= 2.0 for shift in shifts)
    assert any(shift.name == "recorded" for shift in shifts)


def test_a_log_is_not_taken_for_a_street(write_wall, tmp_path):
    street = pytest.importorskip("lidarpainter_models.synthetic.street")
    config = street.SyntheticStreetConfig(seed=1)
    world = object.__new__(street.SyntheticStreet)  # building the world is not what is tested
    world.config = config
    with pytest.raises(SceneError, match="no recording of the street with seed 1"):
        harvest_shifted_street(
            world,
            write_wall("wall"),
            [StreetPlan()],
            PairWriter(tmp_path),
            config=TINY,
            progress=untold,
        )


def test_settings_that_make_no_pairs_are_refused():
    with pytest.raises(ConfigError):
        StreetPlan(num_views=0)
    with pytest.raises(ConfigError):
        HarvestConfig(corrupted_per_view=-1)
