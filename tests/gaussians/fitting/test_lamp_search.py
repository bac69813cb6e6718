"""Lamps that go on and off are found, and nothing else is taken for one."""

from dataclasses import replace

import pytest
import torch
from fitted_street import FittedStreet
from gaussian_world import FRAME_NS, camera_at, map_points, round_gaussians, scene_of, training_view
from strict_device import NAME, strict_runs

from lidarpainter_models.gaussians.fitting import lamp_search
from lidarpainter_models.gaussians.fitting.config import FitConfig, RefinementConfig
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.gaussians.fitting.images import FitImage
from lidarpainter_models.gaussians.fitting.lamp_images import two_levels
from lidarpainter_models.gaussians.fitting.lamp_search import with_lamps_found
from lidarpainter_models.gaussians.model.blinking import NUM_NODES, Blinking
from lidarpainter_models.kernels.pixel_losses import SOLID
from lidarpainter_models.lidar.lidar_map import LidarMap
from lidarpainter_models.observations.views import SceneObservations
from lidarpainter_models.synthetic import SyntheticStreet, SyntheticStreetConfig
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS

NUM_IMAGES = 10
FLASHES = (0, 0, 1, 1, 0, 0, 0, 1, 1, 1)
PLACE_M = (8.3, 0.15, 0.6)
RED = torch.tensor([0.5, 0.1, 0.05])


@pytest.fixture(scope="module")
def wall():
    """A speckled wall and the cameras that pass it."""
    generator = torch.Generator().manual_seed(3)
    y, z = torch.meshgrid(torch.linspace(-6, 6, 60), torch.linspace(-4, 3, 36), indexing="ij")
    wall_m = torch.stack([8.0 + 0.6 * torch.rand(y.shape, generator=generator), y, z], dim=-1)
    wall_m = wall_m.flatten(0, 1)
    rgb = 0.4 * torch.rand(wall_m.shape[0], 3, generator=generator)
    cameras = [camera_at(0.1 * frame, width_px=96, height_px=72) for frame in range(NUM_IMAGES)]
    return scene_of(round_gaussians(wall_m, rgb, sigma_m=0.12), cameras), cameras


def with_lamp(scene, is_lit, size_m=0.5):
    lamp = Blinking(
        bodies=torch.tensor([0]),
        centre_m=torch.tensor([PLACE_M]),
        size_m=torch.tensor([[1.0, size_m, size_m]]),
        lit_rgb=RED.expand(1, NUM_NODES, 3).clone(),
        knots_ns=torch.arange(NUM_IMAGES) * FRAME_NS,
        is_lit=torch.tensor(is_lit).float()[:, None],
    )
    return replace(scene, blinking=lamp)


def images_of(scene, cameras):
    """What the cameras record of a scene."""
    shown = [scene.render(camera, frame * FRAME_NS).rgb for frame, camera in enumerate(cameras)]
    return [
        FitImage(
            camera=camera,
            timestamp_ns=frame * FRAME_NS,
            camera_name="front",
            rgb_u8=(rgb.clamp(0, 1) * 255).round().to(torch.uint8),
            kind=torch.full(rgb.shape[:2], SOLID, dtype=torch.uint8),
            lidar_depth_m=torch.zeros(rgb.shape[:2]),
        )
        for frame, (camera, rgb) in enumerate(zip(cameras, shown, strict=True))
    ]


def found_in(scene, true_scene, cameras, most=NUM_IMAGES):
    return with_lamps_found(scene, images_of(true_scene, cameras), cameras, most)


def error(scene, true_scene, cameras):
    """Mean squared, over all images."""
    times = [frame * FRAME_NS for frame in range(NUM_IMAGES)]
    pairs = [
        (scene.render(camera, time_ns).rgb, true_scene.render(camera, time_ns).rgb)
        for camera, time_ns in zip(cameras, times, strict=True)
    ]
    return float(torch.stack([(one - other).square().mean() for one, other in pairs]).mean())


def test_a_lamp_is_found_where_it_is_with_when_it_is_on(wall):
    scene, cameras = wall
    true_scene = with_lamp(scene, FLASHES)
    mean = with_lamp(scene, [sum(FLASHES) / NUM_IMAGES] * NUM_IMAGES)
    dimmed = scene.with_gaussians(mean.blinking.lit(scene.gaussians, 0))
    found = found_in(dimmed, true_scene, cameras)
    assert found.blinking.bodies.tolist() == [0]
    assert float((found.blinking.centre_m[0] - torch.tensor(PLACE_M)).abs().max()) < 0.4
    assert found.blinking.is_lit[:, 0].tolist() == list(FLASHES)
    assert error(found, true_scene, cameras) < 0.25 * error(dimmed, true_scene, cameras)
    lamps = torch.arange(len(found.blinking))
    own, _ = found.blinking.inside(found.gaussians.means, found.gaussians.body_index, lamps)
    stays = torch.ones(len(found.gaussians), dtype=torch.bool)
    stays[own] = False
    assert torch.equal(found.gaussians.sh_dc[stays], dimmed.gaussians.sh_dc[stays])


def test_a_dark_spell_is_a_lamp_that_is_off(wall):
    scene, cameras = wall
    found = found_in(scene, with_lamp(scene, [1 - lit for lit in FLASHES]), cameras)
    assert found.blinking.is_lit[:, 0].tolist() == [1 - lit for lit in FLASHES]


@pytest.mark.parametrize(
    ("is_lit", "size_m"),
    [
        pytest.param((0,) * NUM_IMAGES, 0.5, id="nothing"),
        pytest.param((0, 0, 0, 0, 1, 0, 0, 0, 0, 0), 0.5, id="one image"),
        pytest.param(torch.linspace(0, 1, NUM_IMAGES).tolist(), 0.5, id="a slow change"),
        pytest.param(FLASHES, 3.0, id="a shadow"),
    ],
)
def test_what_is_no_lamp_leaves_the_scene_as_it_is(wall, is_lit, size_m):
    scene, cameras = wall
    found = found_in(scene, with_lamp(scene, is_lit, size_m), cameras)
    assert not len(found.blinking)
    assert torch.equal(found.gaussians.sh_dc, scene.gaussians.sh_dc)


def test_images_that_are_not_searched_still_say_when_a_lamp_is_on(wall):
    scene, cameras = wall
    cameras = [camera for camera in cameras for _ in range(2)]
    true_scene = with_lamp(scene, FLASHES)
    images = images_of(true_scene, cameras[::2])
    images = [
        replace(image, timestamp_ns=image.timestamp_ns + late)
        for image in images
        for late in (0, FRAME_NS // 4)
    ]
    found = with_lamps_found(scene, images, cameras, NUM_IMAGES)
    assert len(found.blinking.knots_ns) == 2 * NUM_IMAGES
    assert found.blinking.is_lit[:, 0].tolist() == [lit for lit in FLASHES for _ in range(2)]


def test_lamps_are_found_alike_on_another_device(wall, monkeypatch):
    scene, cameras = wall
    on_cpu = found_in(scene, with_lamp(scene, FLASHES), cameras)
    images = images_of(with_lamp(scene, FLASHES), cameras)
    with strict_runs(monkeypatch) as device:
        found = with_lamps_found(scene.to(device), images, cameras, NUM_IMAGES)
        assert found.blinking.lit_rgb.device.type == NAME
        again = found.to(torch.device("cpu"))
    assert torch.equal(again.blinking.is_lit, on_cpu.blinking.is_lit)
    assert torch.allclose(again.blinking.lit_rgb, on_cpu.blinking.lit_rgb, atol=1e-5)
    assert torch.allclose(again.gaussians.sh_dc, on_cpu.gaussians.sh_dc, atol=1e-5)


def test_a_lamp_at_the_border_of_all_images_is_left_out_or_measured(wall):
    scene, cameras = wall
    beside = [replace(camera, cx_px=-3.0) for camera in cameras]
    found = found_in(scene, with_lamp(scene, FLASHES), beside)
    assert len(found.blinking) <= 1
    assert error(found, with_lamp(scene, FLASHES), beside) <= error(
        scene, with_lamp(scene, FLASHES), beside
    )


def test_what_is_hidden_tells_nothing_of_a_lamp(wall):
    scene, cameras = wall
    images = images_of(with_lamp(scene, FLASHES), cameras)
    is_left = (torch.arange(96) < 70).expand(72, 96)
    covered = [
        replace(image, hidden=is_left) if frame % 3 == 1 else image
        for frame, image in enumerate(images)
    ]
    found = with_lamps_found(scene, covered, cameras, NUM_IMAGES)
    lit = found.blinking.is_lit[:, 0]
    seen = [frame for frame in range(NUM_IMAGES) if frame % 3 != 1]
    assert lit[seen].tolist() == [FLASHES[frame] for frame in seen]


def test_boxes_that_overlap_are_one():
    cells = torch.tensor([[0, 0, 0, 0], [0, 0, 2, 0], [0, 1, 2, 0], [0, 2, 2, 0], [0, 2, 1, 0]])
    cells = torch.cat([cells, torch.tensor([[0, 2, 0, 0], [1, 0, 0, 0], [1, 9, 0, 0]])])
    lamps = lamp_search._boxes(cells)
    assert sorted(lamps.bodies.tolist()) == [0, 1, 1]
    (large,) = lamps.size_m[lamps.bodies == 0]
    assert large.tolist() == pytest.approx([0.8, 0.8, 0.4])
    far_apart = torch.tensor([[0, 10 * place, 0, 0] for place in range(3)])
    assert len(lamp_search._boxes(far_apart)) == 3


def test_levels_are_parted_where_most_is_explained():
    pixels = torch.full((3, 7), 4.0)
    value = torch.tensor(
        [
            [0.0, 0.3, 0.0, 0.3, 0.3, 0.0, 9.0],
            [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 9.0],
            [0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 9.0],
        ]
    )
    pixels[:, -1] = 0.5  # not seen
    error = torch.zeros(3, 7, 3)
    error[..., 2] = 4 * value
    levels = two_levels(pixels, error)
    assert levels.explained[0] == pytest.approx(1.0)
    assert 0.7 < float(levels.explained[1]) < 0.8  # even values
    assert levels.change[:2].tolist() == pytest.approx([0.3, 0.3])
    assert levels.is_high[0].tolist() == [False, True, False, True, True, False, False]
    assert levels.is_high[1].tolist() == [False, False, False, True, True, True, False]
    assert float(levels.change[2]) < 1e-6
    few = two_levels(pixels[:1, :5], error[:1, :5])
    assert float(few.explained[0]) == 0.0


@pytest.mark.slow
def test_a_fit_keeps_the_lamps_it_finds_and_a_continuation_does_not_look(wall):
    scene, cameras = wall
    images = images_of(with_lamp(scene, FLASHES), cameras)
    views = tuple(
        training_view(image.camera, frame=frame, rgb_u8=image.rgb_u8)
        for frame, image in enumerate(images)
    )
    points = map_points(scene.gaussians.means, scene.gaussians.base_rgb)
    seen = SceneObservations(views=views, lidar_map=LidarMap(street=points, actors={}), tracks=())
    refinement = RefinementConfig(cameras=False, start_step=0)
    config = FitConfig(steps=100, half_resolution=0.0, refinement=refinement)
    found = fit_gaussians(seen, config, start=scene).scene
    assert found.blinking.is_lit[:, 0].tolist() == list(FLASHES)
    blind = replace(config, refinement=replace(refinement, lamps=False))
    assert not len(fit_gaussians(seen, blind, start=scene).scene.blinking)
    for continued in (blind, config):
        again = fit_gaussians(seen, replace(continued, steps=5), start=found).scene
        assert torch.equal(again.blinking.lit_rgb, found.blinking.lit_rgb)


def lens_pixels(street, camera, timestamp_ns):
    """Pixels that show the lens of a lamp that switches, or touch one."""
    is_lens = torch.zeros(camera.height_px, camera.width_px, dtype=torch.bool)
    actors = street.actors(timestamp_ns)
    for lens in street.lamps(timestamp_ns):
        signs = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], dtype=torch.float64)] * 3)
        corners = lens.centre_m + signs * lens.size_m
        if lens.actor_index >= 0:
            pose = actors[lens.actor_index].world_from_box
            corners = corners @ pose[:3, :3].T + pose[:3, 3]
        uv, depth_m = camera.project(corners)
        if float(depth_m.min()) > 1.0:
            (left, top), (right, bottom) = uv.amin(dim=0).long() - 1, uv.amax(dim=0).long() + 2
            is_lens[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = True
    return is_lens


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
def test_lamps_of_a_street_are_lit_as_they_were(seed, tmp_path, capsys):
    config = SyntheticStreetConfig(
        seed=seed,
        num_frames=20,
        width_px=320,
        height_px=180,
        cameras=DEFAULT_CAMERAS[:1],
        are_lamps_switching=True,
    )
    street, found = SyntheticStreet(config), {}
    for lamps in (True, False):
        fit = FitConfig(refinement=RefinementConfig(lamps=lamps))
        fitted = FittedStreet(config, tmp_path / str(lamps), fit)
        of_all, of_lenses = [], []
        for _, view, image in fitted.shown():
            squared = (image - view.truth_rgb).square().mean(dim=-1)
            of_all.append(-10 * squared.mean().log10())
            of_lenses.append(squared[lens_pixels(street, view.camera, view.timestamp_ns)])
        lenses = -10 * float(torch.cat(of_lenses).mean().log10())
        found[lamps] = (float(torch.stack(of_all).mean()), lenses, len(fitted.scene.blinking))
    with capsys.disabled():
        print(f"\nstreet {seed}: {found}")  # noqa: T201
    assert found[True][1] > found[False][1] + 2.0
    assert found[True][0] > found[False][0] + 0.2
