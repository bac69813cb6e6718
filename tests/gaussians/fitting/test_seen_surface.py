import math
from dataclasses import replace

import pytest
import torch

from lidarpainter_models.gaussians.fitting.seen_surface import (
    CELL_PX,
    LEAST_DETAIL,
    TYPICAL_CONTRAST,
    seen_surface,
    with_shown_beside,
)
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.observations.views import GuidanceView, TrainingView

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 240, 120, 200.0
PIXELS = WIDTH_PX * HEIGHT_PX
WALL_M = 40.0
FRAME_NS = 100_000_000


def view_at(forward_m, frame=0, *, camera="front", yaw_rad=0.0, sky=False):
    """A camera that looks along x at a wall across the road, 40 m from the origin."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[sin, 0, cos], [-cos, 0, sin], [0, -1, 0]], dtype=torch.float64)
    pose[0, 3] = forward_m
    return TrainingView(
        key=(frame, camera),
        camera=Camera.centred(pose, FOCAL_PX, width_px=WIDTH_PX, height_px=HEIGHT_PX),
        timestamp_ns=frame * FRAME_NS,
        rgb_u8=torch.zeros(HEIGHT_PX, WIDTH_PX, 3, dtype=torch.uint8),
        sky_mask=torch.full((HEIGHT_PX, WIDTH_PX), sky),
        lidar_depth_m=torch.full((HEIGHT_PX, WIDTH_PX), WALL_M - forward_m),
    )


def test_one_view_shows_all_its_pixels():
    surface = seen_surface([view_at(0.0)])
    assert (surface.num_pixels, surface.whole_views) == (PIXELS, 1.0)
    assert surface.groups == ((0,),)


def test_points_of_the_street_tell_how_near_it_is_where_the_lidar_does_not():
    """Else all would be far away, and views from one end to the other show the same."""
    views = [
        replace(view, lidar_depth_m=torch.zeros_like(view.lidar_depth_m))
        for view in (view_at(0.0), view_at(10.0), view_at(20.0))
    ]
    steps = torch.linspace(-40, 40, 400)
    wall = torch.cartesian_prod(torch.tensor([WALL_M]), steps, steps)
    swept = seen_surface([view_at(0.0), view_at(10.0), view_at(20.0)])
    assert seen_surface(views, wall).num_pixels == pytest.approx(swept.num_pixels, rel=0.01)
    assert seen_surface(views).num_pixels < 0.7 * swept.num_pixels


def test_a_standing_car_shows_one_view_however_long_it_stands():
    generator = torch.Generator().manual_seed(0)
    views = [view_at(0.0, frame) for frame in range(50)]
    shaken = [
        replace(
            view, lidar_depth_m=view.lidar_depth_m + 0.05 * torch.randn((), generator=generator)
        )
        for view in views
    ]
    for standing in (views, shaken):
        surface = seen_surface(standing)
        assert (surface.num_pixels, surface.whole_views) == (PIXELS, 1.0)
        assert surface.groups == (tuple(range(50)),)


@pytest.mark.parametrize("steps", [5, 10, 20])
def test_a_wall_counts_at_the_finest_it_was_seen_whatever_the_way_there(steps):
    """From 40 m to 20 m: the first image, then what comes closer; 4 times the pixels of a metre."""
    views = [view_at(20.0 * step / steps, step) for step in range(steps + 1)]
    expected = 1 + sum(
        1 - ((40 - 20 * (step + 1) / steps) / (40 - 20 * step / steps)) ** 2
        for step in range(steps)
    )
    assert seen_surface(views).whole_views == pytest.approx(expected, rel=1e-3)
    assert seen_surface(views[::-1]).num_pixels == seen_surface(views).num_pixels


def test_driving_back_shows_nothing_new_of_a_wall():
    near, far = view_at(20.0, 0), view_at(0.0, 1)
    inside = seen_surface([near, far]).whole_views
    assert inside == pytest.approx(1 + 0.75, abs=0.1)  # its rim was out of the nearer image


def test_cameras_that_overlap_share_and_those_that_do_not_add_up():
    right = view_at(0.0, camera="right", yaw_rad=-math.pi / 2)
    assert seen_surface([view_at(0.0), right]).whole_views == pytest.approx(2.0)
    same = view_at(0.0, camera="twin")
    surface = seen_surface([view_at(0.0), same])
    assert surface.whole_views == pytest.approx(1.0)
    assert len(surface.groups) == 2  # each camera has its own pose and colours to be found


def street_drive(num_frames, *, metres_a_frame=1.0):
    """Along walls 8 m to both sides, on a road 1.6 m below, with nothing nearer than 60 m ahead."""
    views = []
    for frame in range(num_frames):
        view = view_at(frame * metres_a_frame, frame)
        across, down, _ = view.camera.pixel_directions().abs().clamp(min=1e-3).unbind(dim=-1)
        depth_m = torch.minimum(8.0 / across, 1.6 / down).clamp(max=60.0)
        views.append(replace(view, lidar_depth_m=depth_m))
    return views


def test_a_street_four_times_as_long_has_four_times_the_surface():
    short, long = seen_surface(street_drive(12)), seen_surface(street_drive(48))
    assert 3.0 < long.num_pixels / short.num_pixels <= 4.2
    assert 3.0 < long.whole_views / short.whole_views <= 4.2
    denser = seen_surface(street_drive(24, metres_a_frame=0.5))
    assert denser.num_pixels == pytest.approx(short.num_pixels, rel=0.1)


def striped(view, contrast):
    """The view with stripes a pixel wide, of so much standard deviation."""
    grey = 0.5 + contrast * (1 - 2 * (torch.arange(WIDTH_PX) % 2))
    rgb_u8 = (255 * grey).round().to(torch.uint8)[None, :, None]
    return replace(view, rgb_u8=rgb_u8.expand(HEIGHT_PX, WIDTH_PX, 3).contiguous())


def test_surface_counts_by_its_contrast():
    found = {
        contrast: seen_surface([striped(view_at(0.0), contrast)]).num_detailed / PIXELS
        for contrast in (0.0, TYPICAL_CONTRAST, 3 * TYPICAL_CONTRAST)
    }
    assert list(found.values()) == pytest.approx([LEAST_DETAIL, 1.0, 3.0], rel=0.05)
    half_sky = torch.zeros(HEIGHT_PX, WIDTH_PX, dtype=torch.bool)
    half_sky[: HEIGHT_PX // 2] = True
    below = replace(striped(view_at(0.0), TYPICAL_CONTRAST), sky_mask=half_sky)
    assert seen_surface([below]).num_detailed / PIXELS == pytest.approx(0.5, rel=0.05)


def test_sky_is_no_surface():
    surface = seen_surface([view_at(0.0, sky=True)])
    assert (surface.num_pixels, surface.whole_views) == (0.0, 0.0)
    assert surface.groups == ((0,),)


def painted_at(forward_m, frame=0, *, contrast=0.0, **turned):
    view = striped(view_at(forward_m, frame, **turned), contrast)
    return GuidanceView.of(
        view.camera,
        view.timestamp_ns,
        rgb=view.rgb,
        weight=torch.ones(HEIGHT_PX, WIDTH_PX),
        lidar_depth_m=view.lidar_depth_m,
    )


def test_painted_views_add_what_no_recorded_image_shows_and_count_it_once():
    recorded = [view_at(0.0), view_at(2.0, 1)]
    surface = seen_surface(recorded)
    aside = painted_at(0.0, 0, yaw_rad=1.6)
    more = with_shown_beside(surface, recorded, [aside])
    assert more.num_pixels == pytest.approx(surface.num_pixels + PIXELS, rel=0.02)
    assert (more.whole_views, more.groups) == (surface.whole_views, surface.groups)
    twice = with_shown_beside(surface, recorded, [aside, painted_at(0.0, 1, yaw_rad=1.6)])
    assert twice.num_pixels == pytest.approx(more.num_pixels, rel=0.02)


@pytest.mark.parametrize(
    ("contrast", "a_pixel"), [(0.0, LEAST_DETAIL), (TYPICAL_CONTRAST, 1), (3 * TYPICAL_CONTRAST, 3)]
)
def test_what_painted_views_show_beside_counts_by_their_own_contrast(contrast, a_pixel):
    recorded = [striped(view_at(0.0), 2 * TYPICAL_CONTRAST)]
    surface = seen_surface(recorded)
    aside = painted_at(0.0, yaw_rad=1.6, contrast=contrast)
    more = with_shown_beside(surface, recorded, [aside])
    added = (more.num_detailed - surface.num_detailed) / (more.num_pixels - surface.num_pixels)
    assert added == pytest.approx(a_pixel, rel=0.06)


@pytest.mark.parametrize("forward_m", [0.0, 5.0])
def test_painted_views_of_what_was_recorded_add_nothing_however_near_they_come(forward_m):
    recorded = [view_at(0.0)]
    surface = seen_surface(recorded)
    more = with_shown_beside(surface, recorded, [painted_at(forward_m)])
    assert vars(more) == vars(surface)
    assert with_shown_beside(surface, recorded, []) is surface


def test_a_cell_with_any_return_shows_surface_in_a_painted_view():
    recorded = [view_at(0.0)]
    surface = seen_surface(recorded)
    dense = painted_at(0.0, yaw_rad=1.6)
    few = torch.zeros_like(dense.lidar_depth_f16)
    few[::CELL_PX, ::CELL_PX] = dense.lidar_depth_f16[::CELL_PX, ::CELL_PX]
    sparse = replace(dense, lidar_depth_f16=few)
    more = with_shown_beside(surface, recorded, [sparse])
    assert more.num_pixels == pytest.approx(surface.num_pixels + PIXELS, rel=0.02)
