"""A scene that lives in a style: the law of fog, light that travels with its car, day and night."""

import math
from dataclasses import replace

import pytest
import torch
from gaussian_world import FRAME_NS, camera_at
from styled_world import CAR_Y_M, NUM_FRAMES, STEP_M, WALL_M, camera_above, clear_scene, styled

from lidarpainter_models.gaussians.model.stored_scene import scene_from_arrays, scene_to_arrays
from lidarpainter_models.gaussians.model.styling.scene_style import LampChange
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.weather.light import luminance, to_linear

WHOLE_MIX = "foggy:0.5+night:0.7+rain:0.5"


def light_of(render):
    return luminance(to_linear(render.rgb.clamp(0, 1)))


@pytest.fixture(scope="module")
def clear():
    return clear_scene()


def test_no_strength_is_the_clear_scene_bit_for_bit(clear):
    camera = camera_at(0.0)
    nothing = styled("foggy:0+night:0..0+rain:0", scene=clear)
    assert torch.equal(nothing.render(camera, 0).rgb, clear.render(camera, 0).rgb)
    assert nothing.baked(0).gaussians is clear.gaussians


def test_fog_is_that_of_the_law_at_the_end_of_the_road(clear):
    camera = camera_at(0.0)
    plain, shown = (scene.render(camera, 0) for scene in (clear, styled("foggy", scene=clear)))
    row, column = camera.height_px // 2 - 4, 24  # the wall, beside the car
    assert float(plain.depth_m[row, column]) == pytest.approx(WALL_M, abs=0.3)
    through = math.exp(-math.log(50) / 120 * WALL_M)
    air = 0.8 * torch.tensor([0.5, 0.55, 0.6])
    air = air + 0.85 * (luminance(air) - air)
    expected = to_linear(plain.rgb[row, column]) * through + air * (1 - through)
    found = to_linear(shown.rgb[row, column])
    # rays beside the axis are longer than the depth by 3 %, alpha there is above 0.99
    torch.testing.assert_close(found, expected, rtol=0.03, atol=0)


def test_half_the_strength_is_half_the_extinction(clear):
    camera = camera_at(0.0)
    half, thin = (styled(text, scene=clear) for text in ("foggy:0.5", "foggy"))
    mix = replace(thin.style.mix, visibility_m=2 * thin.style.mix.visibility_m)
    thin = replace(thin, style=replace(thin.style, mix=mix))
    torch.testing.assert_close(half.render(camera, 0).rgb, thin.render(camera, 0).rgb)


def test_light_on_the_road_travels_with_its_car(clear):
    """From above: where the road is brighter than without the car's beam moves as the car does."""
    camera = camera_above(15.0)
    lit = styled("night", scene=clear)
    centres = []
    for frame in (0, NUM_FRAMES - 1):
        light = light_of(lit.render(camera, frame * FRAME_NS))
        beam = (light - light.median()).clamp_min(0)
        beam[beam < 0.2 * beam.max()] = 0
        rows = torch.arange(camera.height_px) + 0.5
        columns = torch.arange(camera.width_px) + 0.5
        ahead_m = 30.0 * (camera.cy_px - (beam.sum(1) @ rows) / beam.sum()) / camera.fy_px
        left_m = 30.0 * (camera.cx_px - (beam.sum(0) @ columns) / beam.sum()) / camera.fx_px
        centres.append((15.0 + float(ahead_m), float(left_m)))
    (first_x, first_y), (last_x, last_y) = centres
    assert last_x - first_x == pytest.approx((NUM_FRAMES - 1) * STEP_M, abs=1.0)
    assert first_y == pytest.approx(CAR_Y_M, abs=0.8)
    assert last_y == pytest.approx(CAR_Y_M, abs=0.8)
    assert first_x > 8.0 + 2.2  # before the car, not under it


def test_a_car_seen_from_behind_shows_red_and_from_ahead_white(clear):
    scene = styled("night", scene=clear)
    behind = scene.render(camera_at(0.0), 0).rgb
    red = (behind[..., 0] - behind[..., 1]).max()
    assert float(red) > 0.4
    back = camera_at(0.0).world_from_camera.clone()
    back[:3, :3] = torch.diag(torch.tensor([-1.0, -1.0, 1.0]).double()) @ back[:3, :3]
    back[0, 3] = 22.0
    ahead: Camera = camera_at(0.0).at(back)
    assert float(scene.render(ahead, 0).rgb.amin(dim=-1).max()) > 0.9


def switched(clear, *states, last_ns=10 * FRAME_NS):
    """A night in which the car's lamps do one thing after the other said, up to a time."""
    night = styled("night", scene=clear)
    changes = [
        LampChange(actor_id="car", state=state, first_ns=0, last_ns=last_ns) for state in states
    ]
    return replace(night, style=replace(night.style, lamps=tuple(changes)))


def test_lamps_do_what_they_are_told_as_long_as_they_are(clear):
    behind, above = camera_at(0.0), camera_above(15.0)
    usual = styled("night", scene=clear)
    off, brake = (switched(clear, state, last_ns=FRAME_NS) for state in ("off", "brake"))
    three = (off, usual, brake)
    dark, red, bright = (float(one.render(behind, 0).rgb[..., 0].sum()) for one in three)
    assert bright > 1.05 * red > 1.1 * dark
    beam = [float(light_of(one.render(above, 0)).sum()) for one in three]
    assert beam[0] < 0.9 * beam[1]
    assert beam[2] >= beam[1]
    for scene in (off, brake, switched(clear, "off", "on")):
        again = scene.render(behind, 2 * FRAME_NS).rgb
        assert torch.equal(again, usual.render(behind, 2 * FRAME_NS).rgb)


def test_night_falls_while_the_log_passes(clear):
    camera = camera_at(0.0)
    falling, night = styled("night:0..1", scene=clear), styled("night", scene=clear)
    last_ns = (NUM_FRAMES - 1) * FRAME_NS
    assert torch.equal(falling.render(camera, 0).rgb, clear.render(camera, 0).rgb)
    assert torch.equal(falling.render(camera, last_ns).rgb, night.render(camera, last_ns).rgb)
    dusk = [float(light_of(falling.render(camera, frame * FRAME_NS)).mean()) for frame in (0, 2, 3)]
    assert dusk == sorted(dusk, reverse=True)


def test_rain_wets_the_road_and_not_the_sky_behind_it(clear):
    camera = camera_above(15.0)
    dry, wet = (light_of(scene.render(camera, 0)) for scene in (clear, styled("rain", scene=clear)))
    assert float(wet[20:28, 40:44].mean()) < 0.7 * float(dry[20:28, 40:44].mean())


@pytest.mark.parametrize("text", ["foggy", "night", "rain", WHOLE_MIX])
def test_a_baked_scene_shows_the_style_without_having_it(clear, text):
    camera = camera_at(0.0)
    scene = styled(text, scene=clear)
    baked = scene.baked(0, camera.centre_world)
    assert baked.style is None
    shown, kept = scene.render(camera, 0), baked.render(camera, 0)
    difference = (shown.rgb - kept.rgb).abs().amax(dim=-1)
    # lamps do not shine out of baked Gaussians: their glare is all that is missing
    assert float((difference > 0.01).float().mean()) < (0.5 if "night" in text else 0.001)


def test_a_style_is_stored_with_its_scene(clear):
    camera = camera_at(0.0)
    scene = styled(WHOLE_MIX, scene=clear)
    scene = replace(scene, style=replace(scene.style, lamps=switched(clear, "off").style.lamps))
    arrays, metadata = scene_to_arrays(scene)
    again = scene_from_arrays(arrays, metadata)
    assert again.style is not None
    assert again.style.mix == scene.style.mix
    assert again.style.lamps == scene.style.lamps
    assert torch.equal(again.render(camera, 0).rgb, scene.render(camera, 0).rgb)
