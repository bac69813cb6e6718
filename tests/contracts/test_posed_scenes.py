"""Whoever shows a scene shows the same Gaussians: lit, bent, as the shutter reads them, in a style.

One world has it all: a car whose lamp is on and whose body is bent at one moment, and a camera that
drives on and turns while it reads its columns. Each user is asked for what it makes of that moment
by its own public calls, and has to agree with the image.
"""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from gaussian_world import FRAME_NS, camera_at
from styled_world import clear_scene, styled

from lidarpainter_models.export.contents import scene_contents, world_image
from lidarpainter_models.gaussians.fitting.config import FitConfig, FitLossWeights, GuidanceConfig
from lidarpainter_models.gaussians.fitting.images import FitImage
from lidarpainter_models.gaussians.fitting.lamp_images import Look, lacking
from lidarpainter_models.gaussians.fitting.state import FitState
from lidarpainter_models.gaussians.fitting.step import fit_step
from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.blinking import NUM_NODES, Blinking
from lidarpainter_models.gaussians.model.instance_images import SKY, STREET, instance_image
from lidarpainter_models.geometry.cameras import Shutter
from lidarpainter_models.kernels.pixel_losses import SOLID
from lidarpainter_models.observations.views import GuidanceView
from lidarpainter_models.viewing.scene_nodes import recorded_rgb

ROOT = Path(__file__).parents[2]
CAR = 1
ON_NS, OFF_NS = FRAME_NS, 3 * FRAME_NS
"""The lamp is on and the car bent at the first, at the second neither."""
LIFT_M = 0.6
RED = torch.tensor([0.6, 0.0, -0.2])
ROLLING = Shutter(
    across_s=(0.1, 0.0),
    twist_per_s=torch.tensor([0.0, 0.4, 0.0, 0.0, 0.0, 8.0], dtype=torch.float64),
)
BYTE = 0.5 / 255
"""Images of a fit are bytes."""
WAYS = ("lit", "bent", "read")


def scene_with(*ways):
    """The world with a lamp that is lit, a body that is bent, or both."""
    scene = clear_scene()
    knots_ns, tracks = torch.arange(4) * FRAME_NS, scene.actors.recorded_tracks
    actors = Actors.uncorrected(tracks, knots_ns, bent=[0])
    if "bent" in ways:
        actors.bending.offset_m[1, ..., 2] = LIFT_M
    lamp = Blinking(
        bodies=torch.tensor([CAR]),
        centre_m=torch.zeros(1, 3),
        size_m=torch.tensor([[5.0, 2.0, 1.0]]),
        lit_rgb=RED.expand(1, NUM_NODES, 3).clone(),
        knots_ns=knots_ns,
        is_lit=torch.tensor([0.0, float("lit" in ways), 0.0, 0.0])[:, None],
    )
    return replace(scene, actors=actors, blinking=lamp)


def camera_with(*ways):
    return replace(camera_at(0.0), shutter=ROLLING if "read" in ways else None)


def image_of(*ways, time_ns=ON_NS):
    return scene_with(*ways).render(camera_with(*ways), time_ns).rgb.clamp(0, 1)


@pytest.fixture(scope="module")
def image():
    return image_of(*WAYS)


def fit_image(camera, rgb):
    return FitImage(
        camera=camera,
        timestamp_ns=ON_NS,
        camera_name="front",
        rgb_u8=(rgb * 255).round().to(torch.uint8),
        kind=torch.full(rgb.shape[:2], SOLID, dtype=torch.uint8),
        lidar_depth_m=torch.zeros(rgb.shape[:2]),
    )


def test_the_world_differs_by_every_way(image):
    for left_out in WAYS:
        other = image_of(*(way for way in WAYS if way != left_out))
        assert float((other - image).abs().max()) > 0.1, left_out


def test_a_fit_shows_the_image_on_recorded_and_on_painted_views(image):
    """The perceptual distance is handed what the step draws."""
    scene, camera, shown = scene_with(*WAYS), camera_with(*WAYS), []

    def distance(rendered, _true):
        shown.append(rendered.detach())
        return rendered.sum() * 0

    config = FitConfig(
        steps=4, losses=FitLossWeights(perceptual=1.0), guidance=GuidanceConfig(perceptual=1.0)
    )
    beside = replace(camera, shutter=None)
    painted = GuidanceView.of(
        beside,
        ON_NS,
        rgb=torch.zeros_like(image),
        weight=torch.ones(image.shape[:2]),
        lidar_depth_m=torch.zeros(image.shape[:2]),
    )
    state = FitState.begin(scene, config, image[..., 0].numel(), distance)
    fit_step(state, fit_image(camera, image), 1, (0, painted))
    expected = [scene.render(one, ON_NS).rgb for one in (camera, beside)]
    assert len(shown) == 2
    for one in expected:  # the two are drawn at once, in any order
        assert min(float((one - drawn).abs().max()) for drawn in shown) < 1e-5


def test_masks_cover_what_the_image_shows():
    scene, camera = scene_with(*WAYS), camera_with(*WAYS)
    shown = scene.render(camera, ON_NS)
    who = instance_image(scene, camera, ON_NS)
    assert torch.equal(who == SKY, shown.alpha < 0.5)
    is_car = shown.actor_alpha > 0.55 * shown.alpha
    is_street = shown.actor_alpha < 0.45 * shown.alpha
    assert bool(is_car.any())
    assert bool((who[is_car & (shown.alpha > 0.5)] == CAR).all())
    assert bool((who[is_street & (shown.alpha > 0.5)] == STREET).all())


def test_the_search_for_lamps_finds_nothing_lacking(image):
    scene, camera = scene_with(*WAYS), camera_with(*WAYS)
    pixels, error = lacking(scene, Look(fit_image(camera, image), camera))
    assert float((error.abs() - 3 * BYTE * pixels[:, None]).max()) < 1e-3
    for left_out in ("lit", "bent"):
        other = scene_with(*(way for way in WAYS if way != left_out))
        _, missing = lacking(other, Look(fit_image(camera, image), camera))
        assert float(missing.abs().max()) > 10 * float(error.abs().max()), left_out


@pytest.mark.parametrize("style", [None, "foggy"])
def test_a_file_of_one_moment_shows_the_image(style):
    scene, camera = scene_with("lit", "bent"), camera_with()
    if style is not None:
        scene = styled(style, scene=scene)
    baked = scene.baked(ON_NS, camera.centre_world)
    exported = scene_contents(baked, "street", [ON_NS]).placed(0)
    expected = scene.render(camera, ON_NS).rgb
    assert torch.allclose(world_image(exported, camera, baked.sky), expected, atol=2e-3)


def test_a_file_of_many_moments_has_lamps_as_on_average_and_nobody_bent():
    """No such format can change Gaussians from one moment to the next."""
    scene = scene_with("lit", "bent")
    (car,) = scene_contents(scene, "street", [0, ON_NS, OFF_NS]).actors
    own = scene.gaussians.body_index == CAR
    assert torch.equal(car.gaussians.means, scene.gaussians.means[own])
    gain = car.gaussians.base_rgb - scene.gaussians.base_rgb[own]
    assert float(gain[:, 0].max()) == pytest.approx(float(RED[0]) / 4, abs=1e-4)


def test_a_browser_has_the_colours_of_the_image():
    """What is lit is lit, and seen by the camera where it is bent to as its pixel is read."""
    scene, camera = scene_with(*WAYS), camera_with(*WAYS)
    drawn = scene.drawable(camera, ON_NS).gaussians
    own = drawn.body_index == CAR
    found = recorded_rgb(scene, [(camera, ON_NS)])[scene.gaussians.body_index == CAR]
    assert torch.allclose(found, drawn.select(own.nonzero()[:, 0]).base_rgb, atol=1e-5)
    away = scene_with(*WAYS)
    away.actors.bending.offset_m[1, ..., 0] = -60.0  # behind the camera
    assert torch.equal(recorded_rgb(away, [(camera, ON_NS)]), _own_rgb(away, camera))


def _own_rgb(scene, camera):
    """As without the car: its Gaussians keep their own colour, which no camera has seen."""
    own = scene.gaussians.body_index == CAR
    street = recorded_rgb(replace(scene, blinking=Blinking.none()), [(camera, ON_NS)])
    return torch.where(own[:, None], scene.gaussians.base_rgb, street)


def test_a_style_changes_colours_and_nothing_else():
    camera = camera_with(*WAYS)
    clear, foggy = scene_with(*WAYS), styled("foggy", scene=scene_with(*WAYS))
    seen, hazy = (scene.render(camera, ON_NS) for scene in (clear, foggy))
    assert torch.allclose(seen.alpha, hazy.alpha, atol=1e-5)
    assert torch.allclose(seen.depth_m, hazy.depth_m, atol=1e-3)
    assert float((seen.rgb - hazy.rgb).abs().max()) > 0.1
    assert torch.equal(instance_image(clear, camera, ON_NS), instance_image(foggy, camera, ON_NS))
    dark = styled("foggy", scene=scene_with("bent", "read")).render(camera, ON_NS)
    redder = (hazy.rgb - dark.rgb)[..., 0]
    assert float(redder.max()) > 0.1


@pytest.mark.parametrize(
    "call", [".lit", ".lit_on_average", ".bent", "as_read", "bodies_while_read", "PosedScene.of"]
)
def test_lamps_bending_and_shutters_are_asked_in_one_place(call):
    before = r"\w" if call.startswith(".") else r"(?<!def )\b"
    callers = {
        path.name
        for top in ("lidarpainter_models", "tasks", "flows")
        for path in (ROOT / top).rglob("*.py")
        if re.search(rf"{before}{re.escape(call)}\(", path.read_text("utf-8"))
    }
    assert callers == {"gaussian_scene.py" if call == "PosedScene.of" else "scene_rendering.py"}
