"""Frames painted in order, each leaning on the one before."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.conditioning.novel_guidance import novel_cameras, paint_novel_views
from lidarpainter_models.conditioning.scene_styles import style_view
from lidarpainter_models.conditioning.sequences import SequencePainter
from lidarpainter_models.conditioning.settings import NovelGuidanceConfig, SequenceConfig
from lidarpainter_models.conditioning.warping import WarpTarget
from lidarpainter_models.geometry.cameras import Shutter
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.painter.protocol import Painting

STEP_NS = 100_000_000
MIXED = SequenceConfig(previous="mixed")


class FlickeringPainter:
    """Adds another noise to the render every time; remembers what it was shown."""

    name = "flickering"

    def __init__(self, strength=0.05):
        self.generator = torch.Generator().manual_seed(0)
        self.strength = strength
        self.shown = []

    def paint(self, conditions):
        self.shown.append(conditions)
        noise = torch.rand(conditions.render_rgb.shape, generator=self.generator) - 0.5
        rgb = (conditions.render_rgb + self.strength * noise).clamp(0, 1)
        return Painting(rgb=rgb, confidence=torch.ones(rgb.shape[:2]))


@pytest.fixture
def path(camera_at):
    return [(camera_at(0.2 + 0.3 * step, 0.4), STEP_NS * step) for step in range(4)]


def paint_path(builder, painter, config, path):
    sequence = SequencePainter(builder, painter, config=config)
    return [sequence.paint(*view).painting.rgb for view in path]


def late(camera):
    """The camera with a clock that is one step of the path late."""
    return replace(camera, shutter=Shutter(late_s=STEP_NS / 1e9, twist_per_s=torch.zeros(6)))


@pytest.mark.parametrize("previous", ["unused", "mixed", "shown"])
def test_the_first_frame_is_the_one_painted_alone(previous, builder, path):
    config = SequenceConfig(previous=previous)
    first = paint_path(builder, FlickeringPainter(), config, path)[0]
    alone = FlickeringPainter().paint(builder.conditions(*path[0])).rgb
    assert torch.equal(first, alone)


def test_a_late_frame_is_carried_on_from_when_it_was_taken(builder, path, monkeypatch):
    placed, of_render = [], WarpTarget.of_render
    monkeypatch.setattr(
        WarpTarget, "of_render", lambda *given: placed.append(given[1]) or of_render(*given)
    )
    delayed = [(late(camera), time_ns - STEP_NS) for camera, time_ns in path]
    paint_path(builder, FlickeringPainter(), MIXED, delayed)
    assert placed == [time_ns for _, time_ns in path[1:]]


def test_a_late_image_is_styled_with_the_lidar_of_when_it_was_taken(builder, path, monkeypatch):
    asked, lidar_image = [], builder.lidar_image
    monkeypatch.setattr(
        builder, "lidar_image", lambda *given: asked.append(given[1]) or lidar_image(*given)
    )
    camera, time_ns = path[2]
    image = torch.zeros(camera.height_px, camera.width_px, 3)
    style_view(builder, late(camera), time_ns - STEP_NS, image)
    assert asked == [time_ns]


def test_unused_frames_change_nothing(builder, path):
    alone = FlickeringPainter()
    expected = [alone.paint(builder.conditions(*view)).rgb for view in path]
    found = paint_path(builder, FlickeringPainter(), SequenceConfig(), path)
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))


def test_mixing_calms_noise_and_keeps_the_image(builder, path):
    plain = paint_path(builder, FlickeringPainter(), SequenceConfig(), path)
    mixed = paint_path(builder, FlickeringPainter(), MIXED, path)
    clean = [builder.conditions(*view).render_rgb for view in path]

    def error(images):
        gaps = [(a - b).abs().mean() for a, b in zip(images, clean, strict=True)]
        return float(torch.stack(gaps[1:]).mean())

    assert error(mixed) < 0.85 * error(plain)


def test_frames_that_disagree_are_not_mixed(builder, path):
    loud = FlickeringPainter(strength=0.0)
    sequence = SequencePainter(builder, loud, config=MIXED)
    sequence.paint(*path[0])
    conditions = builder.conditions(*path[1])
    other = replace(conditions, render_rgb=1 - conditions.render_rgb.round())
    painted = sequence.paint_conditions(other, *path[1]).rgb
    # exp(-0.5 / 0.05) of a share of 0.5
    assert (painted - other.render_rgb).abs().max() < 0.01


def test_the_painter_is_shown_the_previous_frame_first(builder, path):
    painter = FlickeringPainter()
    first, *_ = paint_path(builder, painter, SequenceConfig(previous="shown"), path[:2])
    recorded = builder.conditions(*path[1])
    shown = painter.shown[1]
    assert len(shown.warp_rgb) == len(recorded.warp_rgb) + 1
    assert torch.equal(shown.warp_rgb[1:], recorded.warp_rgb)
    valid = shown.warp_valid[0]
    assert valid.float().mean() > 0.5
    moved = (shown.warp_rgb[0] - first)[valid].abs().mean()
    assert 0 < moved < 0.1
    assert (shown.warp_rgb[0][~valid] == 0).all()


def test_novel_views_lean_on_their_own_path_alone(builder, views):
    shifts = (Shift(lateral_m=1), Shift(lateral_m=-1))
    poses = torch.eye(4, dtype=torch.float64).repeat(10, 1, 1)
    poses[:, 0, 3] = 0.2 * torch.arange(10)
    both = NovelGuidanceConfig(shifts=shifts, sequence=SequenceConfig(previous="shown"))
    cameras = novel_cameras(views, range(10), poses, config=both)
    painter = FlickeringPainter()
    paintings = paint_novel_views(builder, painter, cameras, config=both)
    numbers = [len(conditions.warp_rgb) for conditions in painter.shown]
    alone = len(builder.conditions(cameras[0].camera, 0).warp_rgb)
    per_path = len(paintings) // 2
    assert numbers == 2 * [alone, *[alone + 1] * (per_path - 1)]
