from dataclasses import replace

import numba
import pytest
import torch

from lidarpainter_models.conditioning import conditions
from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.novel_guidance import (
    guidance_views,
    has_room,
    novel_cameras,
    paint_novel_views,
)
from lidarpainter_models.conditioning.settings import ConditionConfig, NovelGuidanceConfig
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.cameras import Shutter
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.lidar.points_on_actors import MovingBoxes
from lidarpainter_models.painter.protocol import Painting

WALL_X_M = 12.0
NUM_VIEWS = 5


class EchoPainter:
    """Gives back the best warped reference where there is one, else the render."""

    name = "echo"

    def paint(self, conditions):
        known = conditions.warp_valid[0][..., None]
        rgb = torch.where(known, conditions.warp_rgb[0], conditions.render_rgb)
        return Painting(rgb=rgb, confidence=torch.ones(rgb.shape[:2]))


class NegativePainter:
    """Makes everything worse."""

    name = "negative"

    def paint(self, conditions):
        rgb = 1 - conditions.render_rgb
        return Painting(rgb=rgb, confidence=torch.ones(rgb.shape[:2]))


def test_conditions_hold_render_lidar_and_references(builder, camera_at, board, draw):
    camera = camera_at(0.6, 0.5)
    truth, depth_m = draw(camera, [board(WALL_X_M, top_m=4.0)])
    found = builder.conditions(camera, 150_000_000)
    on_wall = (depth_m > 0) & found.warp_valid[0]
    assert found.warp_rgb.shape == (2, 48, 64, 3)
    assert on_wall.float().mean() > 0.6
    assert (found.warp_rgb[0] - truth)[on_wall].abs().mean() < 0.01
    assert (found.lidar_rgb - truth)[found.lidar_hit].abs().mean() < 0.05
    assert (found.render_depth_m - depth_m)[on_wall].abs().mean() < 0.2
    assert (found.warp_rgb[~found.warp_valid] == 0).all()
    assert found.render_rgb.max() <= 1


def test_every_view_is_a_source_once_and_the_nearest_comes_first(builder, views, camera_at):
    nearest = builder.sources_for(camera_at(0.8), views[2].timestamp_ns)
    assert nearest[0].key == views[2].key
    assert len({source.key for source in nearest}) == len(nearest) == NUM_VIEWS


def test_sources_that_there_is_no_room_for_are_rendered_again(
    builder, views, camera_at, monkeypatch
):
    everywhere = builder.conditions(camera_at(0.6, 0.5), 150_000_000)
    builder.forget_sources()
    monkeypatch.setattr(conditions, "MOST_SOURCE_BYTES", 1)
    assert torch.equal(
        builder.conditions(camera_at(0.6, 0.5), 150_000_000).warp_rgb, everywhere.warp_rgb
    )
    kept = builder.source(views[2].key)
    assert builder.source(views[2].key) is kept
    builder.source(views[1].key)
    assert builder.source(views[2].key) is not kept


def test_references_have_the_exposure_asked_for(scene, lidar_map, views, camera_at):
    brighter = torch.eye(3, 4)[None] * 1.25
    exposed = replace(scene, exposure=replace(scene.exposure, matrix=brighter))
    builder = ConditionBuilder(exposed, lidar_map, views)
    plain = builder.conditions(camera_at(0.8), 200_000_000)
    named = builder.conditions(camera_at(0.8), 200_000_000, camera_name="front")
    valid = plain.warp_valid[0]
    recorded = views[2].rgb[valid]
    assert torch.allclose(named.warp_rgb[0][valid], recorded, atol=1e-3)
    assert torch.allclose(plain.warp_rgb[0][valid], recorded / 1.25, atol=1e-3)


def test_fewer_sources_than_references_are_refused():
    with pytest.raises(ConfigError, match="num_references"):
        ConditionConfig(num_references=3, num_sources=2)


def ego_path(num_frames=2 * NUM_VIEWS, step_m=0.2):
    path = torch.eye(4, dtype=torch.float64).repeat(num_frames, 1, 1)
    path[:, 0, 3] = step_m * torch.arange(num_frames)
    return path


def test_novel_cameras_stand_beside_and_above_the_path(views):
    config = NovelGuidanceConfig(shifts=(Shift(lateral_m=2), Shift(up_m=1.5)), every_nth=2)
    novel = novel_cameras(views, range(10), ego_path(), config=config)
    assert [camera.key[0] for camera in novel] == [0, 4, 8, 0, 4, 8]
    offset = novel[1].camera.centre_world - views[2].camera.centre_world
    assert offset.tolist() == pytest.approx([0, 2, 0])
    offset = novel[-1].camera.centre_world - views[4].camera.centre_world
    assert offset.tolist() == pytest.approx([0, 0, 1.5])
    assert novel[1].name == "front-004-left-2m"
    later = novel_cameras(views, range(10), ego_path(), config=config, start=1)
    assert [camera.key[0] for camera in later] == [2, 6, 2, 6]


def test_rounds_paint_ever_farther_out():
    shifts = (Shift(lateral_m=2), Shift(lateral_m=-3), Shift(up_m=1.5))
    config = NovelGuidanceConfig(shifts=shifts, outwards_m=1)
    assert config.in_round(1, 7).shifts == shifts
    names = [shift.name for shift in config.in_round(3, 7).shifts]
    assert names == ["left-4m", "right-5m", "up-1.5m"]
    with pytest.raises(ConfigError, match="outwards_m in round 7: -9 m"):
        config.in_round(7, 7)
    for metres in (-1.0, float("nan"), 9.0):
        with pytest.raises(ConfigError, match="outwards_m must lie between 0 and 8"):
            NovelGuidanceConfig(outwards_m=metres)


def test_rounds_share_the_distances_to_the_side():
    config = NovelGuidanceConfig()

    def painted(number, rounds):
        return [shift.name for shift in config.in_round(number, rounds).shifts]

    assert config.in_round(1, 1) == config
    always = ["up-1.5m", "turned-left-40deg", "turned-right-40deg"]
    assert painted(1, 2) == ["left-2m", "right-2m", *always]
    assert painted(2, 2) == ["left-3m", "right-3m", *always]
    assert painted(3, 3) == painted(1, 3) == painted(1, 2)
    up = NovelGuidanceConfig(shifts=(Shift(up_m=1.5),))
    assert up.in_round(2, 2) == up


def test_cameras_turn_to_where_no_camera_of_the_rig_looks(views):
    config = NovelGuidanceConfig(shifts=(Shift(yaw_rad=0.7), Shift(yaw_rad=-0.7)), every_nth=5)
    alone = novel_cameras(views, range(10), ego_path(), config=config)
    assert [camera.shift for camera in alone] == list(config.shifts)
    left = replace(views[0], key=(0, "front_left"), camera=alone[0].camera)
    both = novel_cameras([*views, left], range(10), ego_path(), config=config)
    turned = {(camera.key[1], camera.shift.yaw_rad) for camera in both}
    assert turned == {("front", -0.7), ("front_left", 0.7)}


def test_a_standing_car_still_has_a_left_side(views):
    config = NovelGuidanceConfig(shifts=(Shift(lateral_m=3),))
    novel = novel_cameras(views, range(10), ego_path(step_m=0.0), config=config)
    offset = novel[0].camera.centre_world - views[0].camera.centre_world
    assert offset.tolist() == pytest.approx([0, 3, 0])


def test_of_a_standing_car_an_image_each_half_second_is_painted(views):
    standing = [
        replace(views[0], key=(frame, "front"), timestamp_ns=100_000_000 * frame)
        for frame in range(40)
    ]
    config = NovelGuidanceConfig(shifts=(Shift(lateral_m=3),), every_nth=2)
    novel = novel_cameras(standing, range(40), ego_path(40, step_m=0.0), config=config)
    assert [camera.key[0] for camera in novel] == [0, 10, 20, 30]


def test_a_frame_without_an_ego_pose_is_refused(views):
    with pytest.raises(ConfigError, match="no ego pose"):
        novel_cameras(views, range(3), ego_path(3), config=NovelGuidanceConfig())


def test_an_unknown_camera_is_refused(views):
    config = NovelGuidanceConfig(camera_names=("rear",))
    with pytest.raises(ConfigError, match="rear"):
        novel_cameras(views, range(10), ego_path(), config=config)


def test_painting_gives_guidance_that_trusts_what_was_recorded(builder, views, board, draw):
    config = NovelGuidanceConfig(shifts=(Shift(lateral_m=1),), every_nth=3)
    novel = novel_cameras(views, range(10), ego_path(), config=config)
    told = []
    paintings = paint_novel_views(
        builder, EchoPainter(), novel, config=config, progress=lambda *step: told.append(step)
    )
    assert told == [(1, 2), (2, 2)]
    assert len(guidance_views(paintings)) == 2
    shown = [one for one in paintings if one.images]
    assert len(shown) == len({one.novel.shift for one in paintings})
    images, guidance = shown[0].images, shown[0].guidance
    assert set(images) == {"render", "lidar", "warp", "painted", "confidence"}
    assert images["painted"].dtype == torch.uint8
    truth, _ = draw(guidance.camera, [board(WALL_X_M, top_m=4.0)])
    trusted = images["confidence"][..., 0] > 0.8 * 255
    assert trusted.float().mean() > 0.5
    assert (guidance.rgb - truth)[trusted].abs().mean() < 0.02
    guides = guidance.weight > 0.8
    assert guides.any()
    assert not (guides & ~trusted).any()


def test_views_painted_beside_each_other_are_those_painted_one_by_one(builder, views):
    config = NovelGuidanceConfig(shifts=(Shift(lateral_m=1), Shift(lateral_m=-1)), every_nth=1)
    novel = novel_cameras(views, range(10), ego_path(), config=config)
    before, painted = numba.get_num_threads(), []
    try:
        for threads in (numba.config.NUMBA_NUM_THREADS, 1):
            numba.set_num_threads(threads)
            builder.forget_sources()
            painted.append(paint_novel_views(builder, EchoPainter(), novel, config=config))
    finally:
        numba.set_num_threads(before)
    beside, alone = painted
    assert len(beside) == len(alone) > 2
    for one, other in zip(beside, alone, strict=True):
        assert one.novel is other.novel
        assert torch.equal(one.guidance.rgb, other.guidance.rgb)
        assert torch.equal(one.guidance.weight, other.guidance.weight)
        assert torch.equal(one.guidance.lidar_depth_m, other.guidance.lidar_depth_m)


def test_a_painter_that_makes_things_worse_gives_no_guidance(builder, views):
    config = NovelGuidanceConfig(shifts=(Shift(lateral_m=1),), every_nth=5)
    novel = novel_cameras(views, range(10), ego_path(), config=config)
    paintings = paint_novel_views(builder, NegativePainter(), novel, config=config)
    assert [painting.is_refused for painting in paintings] == [True]
    assert guidance_views(paintings) == []
    assert paintings[0].mean_weight == 0


def test_no_view_is_painted_from_inside_a_wall_or_a_car(lidar_map, views, camera_at, moving_track):
    config = NovelGuidanceConfig()
    novel = novel_cameras(views, range(10), ego_path(), config=config)[0]
    assert has_room(novel, lidar_map, MovingBoxes([]))
    in_wall = replace(novel, camera=camera_at(WALL_X_M, 2.0))
    assert not has_room(in_wall, lidar_map, MovingBoxes([]))
    car = moving_track((0.0, 2.0, 1.0), (5.0, 2.0, 1.0))
    assert not has_room(novel, lidar_map, MovingBoxes([car]))


def test_a_late_image_is_a_source_of_the_time_when_it_was_taken(builder):
    late = Shutter(late_s=0.04, twist_per_s=torch.zeros(6, dtype=torch.float64))
    views = [
        replace(view, camera=replace(view.camera, shutter=late)) for view in builder.training_views
    ]
    found = ConditionBuilder(builder.scene, builder.lidar_map, views)
    view = views[0]
    assert found.source(view.key).timestamp_ns == view.timestamp_ns + 40_000_000
    nearest = found.sources_for(view.camera.at(view.camera.world_from_camera), view.timestamp_ns)
    assert nearest[0].timestamp_ns == view.timestamp_ns + 40_000_000
