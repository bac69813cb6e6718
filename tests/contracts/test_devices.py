"""What a run does after its fit, on another device than the CPU and in plain torch on the CPU."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import build_world
from strict_device import NAME, strict_runs

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.novel_guidance import NovelCamera, paint_novel_views
from lidarpainter_models.conditioning.settings import NovelGuidanceConfig, SequenceConfig
from lidarpainter_models.evaluation.round_gain import round_gain
from lidarpainter_models.evaluation.shown import ShownScene, ViewTimePainting
from lidarpainter_models.evaluation.view_scores import ScoredView, score_views
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.geometry.trajectories import shift_pose
from lidarpainter_models.kernels.backends import kernels_chosen
from lidarpainter_models.metrics.perceptual import PerceptualDistances
from lidarpainter_models.painter.selection import PainterChoice

CPU = torch.device("cpu")
ASIDE = Shift(lateral_m=0.5)
ROUNDING = 1e-4
"""Sums in another order: of weights and colours in [0, 1] over some hundred terms."""


@pytest.fixture(scope="module")
def world():
    """A world whose images end in the recording car's own body."""
    world = build_world()
    hidden = torch.zeros_like(world.observations.views[0].sky_mask)
    hidden[-len(hidden) // 8 :] = True
    views = tuple(replace(view, hidden=hidden) for view in world.observations.views)
    return replace(world, observations=replace(world.observations, views=views))


def painted(world, device):
    """Two views beside the path, the second leaning on the first."""
    seen = world.observations
    cameras = [
        NovelCamera(
            camera=view.camera.at(
                shift_pose(view.camera.world_from_camera, torch.tensor([1.0, 0, 0]), ASIDE)
            ),
            timestamp_ns=view.timestamp_ns,
            shift=ASIDE,
            key=view.key,
        )
        for view in seen.views[:2]
    ]
    builder = ConditionBuilder(world.scene.to(device), seen.lidar_map, seen.views)
    painter = PainterChoice.of("nano").load(device, torch.float32)
    config = NovelGuidanceConfig(sequence=SequenceConfig(previous="mixed"))
    return paint_novel_views(builder, painter, cameras, config=config)


def scores(world, device, *, view_time):
    seen, scene = world.observations, world.scene.to(device)
    builder = ConditionBuilder(scene, seen.lidar_map, seen.views)
    painting = ViewTimePainting(conditions=builder, painter=PainterChoice.of("warp"), device=device)
    shown = ShownScene(scene=scene, painting=painting if view_time else None)
    views = [
        ScoredView(
            name="test",
            camera=view.camera,
            timestamp_ns=view.timestamp_ns,
            truth_rgb=view.rgb,
            actor_ids=("lit",),
            actor_index=(view.lidar_depth_m > 0).int() - 1,
        )
        for view in seen.views[:2]
    ]
    return score_views(shown.renderer("front"), views, distances=PerceptualDistances())


def assert_same_paintings(found, expected):
    assert len(found) == len(expected) == 2
    for one, other in zip(found, expected, strict=True):
        assert one.guidance.rgb.device == CPU
        for name in ("rgb", "weight"):
            mine, theirs = getattr(one.guidance, name), getattr(other.guidance, name)
            assert float((mine - theirs).abs().mean()) < ROUNDING
        assert one.is_refused == other.is_refused


def test_views_are_painted_on_the_device_of_their_scene(world, monkeypatch):
    expected = painted(world, CPU)
    with strict_runs(monkeypatch) as device:
        found = painted(world, device)
    assert device.type == NAME
    assert_same_paintings(found, expected)


def test_views_painted_in_plain_torch_are_those_of_numba(world):
    expected = painted(world, CPU)
    with kernels_chosen("torch"):
        assert_same_paintings(painted(world, CPU), expected)


@pytest.mark.parametrize("view_time", [False, True])
def test_a_scene_is_judged_where_it_lies(world, monkeypatch, view_time):
    expected = scores(world, CPU, view_time=view_time)
    with strict_runs(monkeypatch) as device:
        found = scores(world, device, view_time=view_time)
    assert found.psnr == pytest.approx(expected.psnr, abs=1e-3)
    assert found.ssim == pytest.approx(expected.ssim, abs=1e-5)
    assert found.actors_psnr == pytest.approx(expected.actors_psnr, abs=1e-3)


def test_what_a_round_gained_is_told_where_its_scenes_lie(world, monkeypatch):
    views = [each.guidance for each in painted(world, CPU)]
    expected = round_gain(world.scene, world.scene, world.observations, views)
    with strict_runs(monkeypatch) as device:
        there = world.scene.to(device)
        found = round_gain(there, there, world.observations, views)
    assert found.before_db == pytest.approx(expected.before_db, abs=0.01)
