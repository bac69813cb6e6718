"""Distorted images: lines stay where they are, and what rolls is read by the distorted image."""

import math
from dataclasses import replace

import pytest
import torch

from lidarpainter_models.gaussians.model.rolling_shutter import as_read
from lidarpainter_models.geometry.cameras import Shutter
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.kernels.gaussian_raster import Splats, render_gaussians
from lidarpainter_models.serving.lens_images import DENSITY, LensImage, reading_times
from lidarpainter_models.serving.lens_models import (
    PinholeLens,
    RadialLens,
    RisingCurve,
    SensorCamera,
)
from lidarpainter_models.serving.messages import pose_message, read_request
from lidarpainter_models.serving.protos import sensorsim_pb2 as pb

WIDTH_PX, HEIGHT_PX = 160, 90
HALF_RAD = math.radians(95)


def camera_of(lens, focal_px):
    return SensorCamera(
        lens=lens,
        pixels_per_unit=(focal_px, 0.0, 0.0, focal_px),
        middle_px=(81.0, 44.0),
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
    )


CAMERAS = {
    "rational": camera_of(PinholeLens((-0.25, 0.08, -0.01, 0.02), (0.001, -0.001)), 110.0),
    "fisheye": camera_of(
        RadialLens(RisingCurve((0.0, 1.0, 0.0, -0.02), HALF_RAD), True, HALF_RAD), 48.0
    ),
    "f-theta": camera_of(
        RadialLens(RisingCurve((0.0, 110.0, 0.0, -3.0), 1.3), is_of_angle=True, max_angle_rad=1.3),
        1.0,
    ),
}


def line_of_gaussians(start, end, count=4000):
    """A thin bright line in the frame of a camera."""
    share = torch.linspace(0, 1, count)[:, None]
    return Splats(
        means=torch.tensor(start) + share * (torch.tensor(end) - torch.tensor(start)),
        rotation_wxyz=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scale_m=torch.full((count, 3), 0.01),
        opacity=torch.full((count,), 0.9),
        sh=torch.full((count, 1, 3), 1.7),
        body_index=torch.zeros(count, dtype=torch.int64),
    )


@pytest.mark.parametrize("name", CAMERAS)
def test_a_straight_line_of_the_world_is_where_the_lens_has_it(name):
    camera = CAMERAS[name]
    start, end = [-3.0, -0.9, 4.0], [3.0, 0.6, 3.0]
    splats = line_of_gaussians(start, end)

    def draw(face):
        pose = torch.linalg.inv(face.camera_from_face).float()[None]
        return render_gaussians(splats, pose, face.pinhole).rgb

    shown = LensImage.of(camera).drawn(draw)[..., 0].clamp(min=0)
    exact = camera.project(splats.means.double())
    inside = (exact[:, 0] > 3) & (exact[:, 0] < WIDTH_PX - 3)
    columns = torch.arange(4, WIDTH_PX - 4)
    columns = columns[(columns > exact[inside, 0].min()) & (columns < exact[inside, 0].max())]
    weight = shown[:, columns]
    rows = torch.arange(HEIGHT_PX)[:, None] + 0.5
    found = (weight * rows).sum(0) / weight.sum(0)
    nearest = (exact[None, :, 0] - columns[:, None] - 0.5).abs().argmin(dim=1)
    missed = (found - exact[nearest, 1]).abs()
    assert len(columns) > 60
    assert float(missed.max()) < 0.3


def test_a_lens_that_distorts_nothing_shows_what_a_pinhole_shows(street, view):
    found = street.served.found(view)
    message = street.request(view)
    pinhole = read_request(message).camera
    lens = LensImage.of(pinhole)
    drawn = lens.drawn(
        lambda face: (
            street.scene.render(
                face.at(found.world_from_camera), view.timestamp_ns, camera_name=view.camera_name
            ).rgb
        )
    )
    direct = street.scene.render(found, view.timestamp_ns, camera_name=view.camera_name).rgb
    assert len(lens.faces) == 1
    assert psnr(drawn, direct) > 30  # what finer pixels show of a random scene, and resampling


def test_a_lens_coarser_than_the_fit_is_drawn_as_fine_and_averaged(street, view):
    found = street.served.found(view)
    coarse = read_request(street.request(view)).camera.resized(40, 24)
    lens = LensImage.of(coarse, fitted_px=found.fx_px)
    (face,) = lens.faces
    times = face.at(found.world_from_camera).width_px // face.pinhole.width_px
    assert times > 1
    assert face.at(found.world_from_camera).fx_px == pytest.approx(found.fx_px, rel=0.3)
    ramp = torch.arange(face.pinhole.width_px * times) / times
    rows = face.pinhole.height_px * times
    drawn = lens.drawn(lambda _face: ramp[None, :, None].expand(rows, -1, 3))
    assert float(drawn[12, 30, 0] - drawn[12, 10, 0]) == pytest.approx(20 * DENSITY, rel=0.1)


def waves(rays):
    """Colours that change three pixels of the fisheye from one another."""
    across, down, _ = (rays / rays.norm(dim=-1, keepdim=True)).unbind(dim=-1)
    return (0.5 + 0.5 * torch.sin(100 * across) * torch.sin(80 * down))[..., None].expand_as(rays)


def waves_of(face):
    pinhole = face.at(torch.eye(4, dtype=torch.float64))
    down, across = torch.meshgrid(
        torch.arange(pinhole.height_px), torch.arange(pinhole.width_px), indexing="ij"
    )
    x = (across + 0.5 - pinhole.cx_px) / pinhole.fx_px
    y = (down + 0.5 - pinhole.cy_px) / pinhole.fy_px
    rays = torch.stack([x, y, torch.ones_like(x)], dim=-1).double()
    return waves(rays @ pinhole.world_from_camera[:3, :3].T).float()


def test_a_pixel_of_a_coarse_lens_is_the_mean_over_its_rays():
    camera = CAMERAS["fisheye"]
    shown = LensImage.of(camera, fitted_px=4 * 48.0).drawn(waves_of)
    rays, is_seen = camera.resized(8 * WIDTH_PX, 8 * HEIGHT_PX).pixel_rays()
    mean = torch.nn.AvgPool2d(8)
    exact = mean(waves(rays).float().permute(2, 0, 1)).permute(1, 2, 0)
    inside = mean(is_seen[None].float())[0] == 1
    error = (shown - exact)[inside].square().mean().sqrt()
    assert float(error) < 0.006  # 0.026 by one ray a pixel through a mean as fine as the lens


def psnr(first, second):
    return -10 * float((first.clamp(0, 1) - second.clamp(0, 1)).square().mean().log10())


def test_a_wide_lens_takes_the_faces_that_its_rays_meet():
    wide = LensImage.of(CAMERAS["fisheye"])
    assert [face.name for face in wide.faces] == ["0", "1", "2", "3", "4"]
    owned = torch.zeros(HEIGHT_PX, WIDTH_PX, dtype=torch.int64)
    for face in wide.faces:
        owned[face.rows, face.columns] += torch.from_numpy(face.is_own)
    assert torch.equal(owned, wide.is_seen.long())


ROLLING = {
    pb.ROLLING_TOP_TO_BOTTOM: (0.0, 1.0),
    pb.ROLLING_LEFT_TO_RIGHT: (1.0, 0.0),
    pb.ROLLING_BOTTOM_TO_TOP: (0.0, -1.0),
    pb.ROLLING_RIGHT_TO_LEFT: (-1.0, 0.0),
}
READOUT_US = 30_000
TWIST_PER_S = torch.tensor([0.02, 0.3, -0.01, 0.5, -0.2, 14.0], dtype=torch.float64)


def rolling_request(street, view, direction):
    """The view read from its start to its end by a camera that turns and drives."""
    camera = street.served.found(view)
    message = street.request(view)
    half = TWIST_PER_S * (READOUT_US * 0.5e-6)
    pair = pb.PosePair(
        start_pose=pose_message(camera.world_from_camera @ rigid_from_tangent(-half)),
        end_pose=pose_message(camera.world_from_camera @ rigid_from_tangent(half)),
    )
    message.sensor_pose.CopyFrom(pair)
    message.frame_start_us = view.timestamp_ns // 1000 - READOUT_US // 2
    message.frame_end_us = view.timestamp_ns // 1000 + READOUT_US // 2
    message.camera_intrinsics.shutter_type = direction
    message.ClearField("dynamic_objects")
    return message, camera


@pytest.mark.parametrize("direction", ROLLING)
def test_a_rolling_shutter_is_that_of_the_fit(street, view, direction):
    message, camera = rolling_request(street, view, direction)
    across = ROLLING[direction]
    readout_s = READOUT_US * 1e-6
    shutter = Shutter(
        across_s=(across[0] * readout_s, across[1] * readout_s), twist_per_s=TWIST_PER_S
    )
    request = read_request(message)
    moment = street.served._moment(request)
    expected = moment.scene.render(
        replace(camera, shutter=shutter), view.timestamp_ns, camera_name=view.camera_name
    )
    shown = torch.from_numpy(street.served.frame(request).rgb_u8) / 255
    assert psnr(shown, expected.rgb) > 50  # rounding to bytes; poses of messages are float32
    standing = moment.scene.render(camera, view.timestamp_ns, camera_name=view.camera_name)
    assert psnr(shown, standing.rgb) < 40


def test_gaussians_are_read_by_the_distorted_image_as_by_the_pinhole_that_it_is(street, view):
    message, camera = rolling_request(street, view, pb.ROLLING_TOP_TO_BOTTOM)
    request = read_request(message)
    moment = street.served._moment(request)
    shutter = moment.shutter
    rolled = replace(camera, shutter=shutter)
    posed = moment.scene.posed(rolled, moment.taken_ns)
    seen = street.scene.gaussians
    expected = as_read(seen, posed.bodies, rolled, moment.scene.actors, moment.taken_ns)
    face = LensImage.of(request.camera).faces[0]
    assert torch.equal(face.camera_from_face, torch.eye(4, dtype=torch.float64))
    read_s = reading_times(request.camera, shutter.across_s, face.camera_from_face)
    uv = torch.rand(500, 2) * torch.tensor([camera.width_px, camera.height_px])
    points = torch.cat(
        [(uv - torch.tensor([camera.cx_px, camera.cy_px])) / camera.fx_px, torch.ones(500, 1)], 1
    )
    assert torch.allclose(read_s(points * 7).float(), rolled.read_s(uv), atol=1e-7)
    assert not torch.equal(expected.means, seen.means)


@pytest.mark.parametrize("name", CAMERAS)
def test_a_distorted_lens_rolls_too(street, view, name):
    message, _ = rolling_request(street, view, pb.ROLLING_TOP_TO_BOTTOM)
    request = replace(read_request(message), camera=CAMERAS[name])
    shown = torch.from_numpy(street.served.frame(request).rgb_u8).float() / 255
    still = replace(request, world_from_sensor=request.world_from_middle.expand(2, 4, 4))
    standing = torch.from_numpy(street.served.frame(still).rgb_u8).float() / 255
    middle = slice(HEIGHT_PX // 2 - 2, HEIGHT_PX // 2 + 2)
    assert psnr(shown[middle], standing[middle]) > psnr(shown, standing) + 3
