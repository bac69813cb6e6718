"""Every kernel once by its door, with seeded input: what two backends, or two devices, make of it.

A trial takes a backend and a device. `disagreement` says how far two answers are apart, in one
number that a threshold on which a pixel sits does not spoil.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import torch
from bench_scenes import LEARNED, street_like_splats
from gaussian_world import camera_at
from lit_surfaces import random_scene
from splat_drawing import SPLATS
from torch import Tensor

from lidarpainter_models.geometry.cameras import READ_ROUNDS, Camera, Shutter
from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_tangent
from lidarpainter_models.kernels.backends import Backend
from lidarpainter_models.kernels.box_owners import box_owners
from lidarpainter_models.kernels.colour_sampling import project_inside, read_inside
from lidarpainter_models.kernels.frustum_culling import Blocks, mark_seen, refresh_bounds
from lidarpainter_models.kernels.gaussian_raster import SplatImage, Splats, render_gaussians
from lidarpainter_models.kernels.pixel_losses import PixelFacts, PixelRules, pixel_terms
from lidarpainter_models.kernels.point_blend import blend_points
from lidarpainter_models.kernels.point_splat import splat_points
from lidarpainter_models.kernels.row_motion import motion_until_read
from lidarpainter_models.kernels.scene_light import irradiance, seen_harmonics
from lidarpainter_models.kernels.sky_texture import (
    SkyLayout,
    TexelMoments,
    sample_sky,
    scatter_gradient,
    sky_rays,
    step_texels,
)
from lidarpainter_models.kernels.sparse_adam import (
    AdamState,
    Parameters,
    catch_up,
    present_rows,
    step_rows,
)
from lidarpainter_models.kernels.ssim import l1_ssim_loss, ssim_map

SIZE_PX = (90, 160)
"""Height and width of the images."""
GAUSSIANS, INTERPRETED = (3000, 160, 90), (25, 32, 16)
"""Scenes of the rasteriser: count, width, height; Triton's interpreter gets the small one."""
WIDTHS, LEAST = [3, 4, 3, 1, 3, 9], [1e-15] * 4 + [1e-7] * 2
RATES = [0.03, 2e-3, 1e-2, 3e-2, 6e-3, 6e-4]


@dataclass(frozen=True)
class Trial:
    """A kernel's work."""

    run: Callable[[Backend, torch.device], list[Tensor]]
    tolerance: float
    """Of `disagreement` between float32 on two devices; a few entries may sit on a threshold."""


class Draw:
    """Seeded numbers, made on the CPU so that every device gets the same."""

    def __init__(self, device: torch.device) -> None:
        self._generator, self._device = torch.Generator().manual_seed(0), device

    def uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self._generator).to(self._device)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self._generator).to(self._device)

    def below(self, end: int, *shape: int) -> Tensor:
        return torch.randint(0, end, shape, generator=self._generator).to(self._device)


def disagreement(found: list[Tensor], expected: list[Tensor]) -> float:
    """The largest relative error of any tensor, or share of its entries that are others."""
    worst = 0.0
    for one, other in zip((each.cpu() for each in found), expected, strict=True):
        if other.is_floating_point():
            error = float((one.double() - other.double()).norm())
            worst = max(worst, error / max(float(other.double().norm()), 1e-30))
        else:
            worst = max(worst, float((one != other).double().mean()))
    return worst


def moved(part: Any, device: torch.device) -> Any:
    """A tensor on a device, or a (named) tuple or a dataclass that holds such."""
    if isinstance(part, Tensor):
        return part.to(device)
    if isinstance(part, tuple):
        return type(part)(*(moved(value, device) for value in part))
    if not is_dataclass(part) or isinstance(part, type):
        return part
    kept = {field.name: getattr(part, field.name) for field in fields(part)}
    return replace(part, **{name: moved(value, device) for name, value in kept.items()})


def _boxes(backend: Backend, device: torch.device) -> list[Tensor]:
    draw = Draw(device)
    owners = box_owners(
        3 * draw.normal(5000, 3),
        rigid_from_tangent(2 * draw.normal(7, 6).double()),
        1 + 3 * draw.uniform(7, 3),
        margin_m=0.2,
        floor_m=0.3,
        backend=backend,
    )
    return [owners]


def _motion(backend: Backend, device: torch.device) -> list[Tensor]:
    draw, camera = Draw(device), camera_at(0.0)
    shutter = Shutter(across_s=(0.0, 0.04), twist_per_s=torch.zeros(6))
    poses = camera.camera_from_world.float().expand(3, 4, 4)[:, :3]
    moved = motion_until_read(
        4 * draw.normal(5000, 3) + torch.tensor([10.0, 0.0, 0.0], device=device),
        draw.normal(5000, 4),
        draw.below(3, 5000),
        poses,
        draw.normal(3, 3, 4) * torch.tensor([0.1, 0.1, 0.1, 10.0], device=device),
        replace(camera, shutter=shutter),
        backend=backend,
    )
    return list(moved)


def _splat(backend: Backend, device: torch.device) -> list[Tensor]:
    draw, (height_px, width_px) = Draw(device), SIZE_PX
    size = torch.tensor([width_px, height_px], device=device)
    found = splat_points(
        (draw.uniform(5000, 2) * size).long(),
        20 * draw.uniform(5000) - 2,
        radius_px=draw.below(4, 5000),
        height_px=height_px,
        width_px=width_px,
        backend=backend,
    )
    return [found]


def _blend(backend: Backend, device: torch.device) -> list[Tensor]:
    draw, (height_px, width_px) = Draw(device), SIZE_PX
    size = torch.tensor([width_px, height_px], device=device)
    found = blend_points(
        draw.uniform(1200, 2) * size,
        9.8 + 0.4 * draw.uniform(1200),
        draw.uniform(1200, 3),
        10.0 * (draw.uniform(*SIZE_PX) < 0.8),
        weight=draw.uniform(1200),
        radius_px=0.5 + 3 * draw.uniform(1200),
        backend=backend,
    )
    return list(found)


def _projection(backend: Backend, device: torch.device) -> list[Tensor]:
    """Which points fall into an image, and where: all of the colouring that runs on a GPU."""
    draw, (height_px, width_px) = Draw(device), SIZE_PX
    points = 20 * draw.uniform(5000, 3) - 10
    lens = torch.tensor([[80.0, 0, width_px / 2, 0], [0, 80, height_px / 2, 0], [0, 0, 1, 0.5]])
    rows, pixels_uv, depth_m = project_inside(
        points, lens.double(), width_px, height_px, 0.5, backend=backend
    )
    inside = torch.zeros(len(points), dtype=torch.bool, device=device)
    inside[rows] = True
    seen = torch.zeros_like(points)
    seen[rows] = torch.cat([pixels_uv, depth_m[:, None]], dim=1)
    camera = Camera.centred(torch.eye(4).double(), 80.0, width_px=width_px, height_px=height_px)
    shutter = Shutter(across_s=(0.0, 0.03), twist_per_s=torch.tensor([0, 0.3, 0, 0, 0, 20.0]))
    packed = replace(camera, shutter=shutter).packed()
    rows, pixels_uv, depth_m = read_inside(points, packed, 4, 0.5, READ_ROUNDS, backend=backend)
    read = torch.zeros_like(points)
    read[rows] = torch.cat([pixels_uv, depth_m[:, None]], dim=1)
    return [inside, seen, read]


def _image_loss(backend: Backend, device: torch.device) -> list[Tensor]:
    draw = Draw(device)
    rendered, target = draw.uniform(*SIZE_PX, 3).requires_grad_(), draw.uniform(*SIZE_PX, 3)
    weighted = l1_ssim_loss(rendered, target, pixel_weight=draw.uniform(*SIZE_PX), backend=backend)
    similarity = ssim_map(rendered, target, backend=backend)
    (weighted + l1_ssim_loss(rendered, target, backend=backend) + similarity.mean()).backward()
    alone = ssim_map(target, rendered.detach(), backend=backend)
    return [weighted.detach(), similarity.detach(), alone, _gradient(rendered)]


def _pixel_terms(backend: Backend, device: torch.device) -> list[Tensor]:
    draw = Draw(device)
    leaves = [draw.uniform(*SIZE_PX, 3), 20 * draw.uniform(*SIZE_PX), draw.uniform(*SIZE_PX)]
    leaves = [*leaves, draw.uniform(*SIZE_PX, 3), draw.uniform(3, 4)]
    leaves = [leaf.requires_grad_() for leaf in leaves]
    image = SplatImage(
        rgb=leaves[0],
        depth_m=leaves[1],
        alpha=leaves[2],
        features=torch.zeros(*SIZE_PX, 0, device=device),
        visible=torch.zeros(0, dtype=torch.bool, device=device),
    )
    facts = PixelFacts(
        rgb=draw.uniform(*SIZE_PX, 3),
        kind=draw.below(4, *SIZE_PX).to(torch.uint8),
        lidar_depth_m=20 * draw.uniform(*SIZE_PX) * (draw.uniform(*SIZE_PX) > 0.5),
    )
    rules = PixelRules(sky_tolerance=0.3, depth_tolerance=0.05, min_transmittance=0.2)
    terms = pixel_terms(image, leaves[3], facts, rules, exposure=leaves[4], backend=backend)
    (terms.shown.sum() + terms.sky + terms.depth).backward()
    found = [terms.shown.detach(), terms.sky.detach(), terms.depth.detach()]
    return [*found, *(_gradient(leaf) for leaf in leaves)]


def _gradient(leaf: Tensor) -> Tensor:
    assert leaf.grad is not None
    return leaf.grad


def _sky(backend: Backend, device: torch.device) -> list[Tensor]:
    draw, (height_px, width_px) = Draw(device), SIZE_PX
    layout = SkyLayout(
        azimuth_left_rad=math.pi,
        elevation_top_rad=math.pi / 2,
        texel_rad=2 * math.pi / 128,
        columns=128,
        rows=32,
    )
    camera = camera_at(0.0, width_px=width_px, height_px=height_px)
    wanted = torch.ones(SIZE_PX, dtype=torch.bool, device=device)
    texture = draw.uniform(layout.rows, layout.columns, 3)
    rays = sky_rays(camera, layout, wanted, backend=backend)
    seen = sample_sky(texture, rays, layout, backend=backend)
    found = scatter_gradient(
        draw.normal(*SIZE_PX, 3), draw.uniform(*SIZE_PX), rays, layout, backend=backend
    )
    moments = TexelMoments(
        first=torch.zeros_like(texture),
        second=torch.zeros_like(texture),
        visits=torch.zeros(texture.shape[:2], dtype=torch.int32, device=device),
    )
    step_texels(texture, moments, *found, 0.01, backend=backend)
    return [seen, *found, texture]


def _culling(backend: Backend, device: torch.device) -> list[Tensor]:
    draw, count, num_blocks = Draw(device), 6000, 90
    block_of_row = torch.arange(count, device=device) % num_blocks
    order = torch.argsort(block_of_row, stable=True)
    numbers = torch.arange(num_blocks + 1, device=device)
    low, high = torch.full((2, num_blocks, 3), 99.0, dtype=torch.float64, device=device)
    blocks = Blocks(
        order=order,
        first=torch.searchsorted(block_of_row[order], numbers),
        body=torch.zeros(num_blocks, dtype=torch.int32, device=device),
        low=low,
        high=high,
        reach=torch.zeros(num_blocks, dtype=torch.float64, device=device),
    )
    means = 30.0 * draw.normal(num_blocks, 3)[block_of_row] + draw.normal(count, 3)
    stale = torch.ones(num_blocks, dtype=torch.bool, device=device)
    scale = draw.normal(count, 3) - 2.0
    refresh_bounds(blocks, means, scale, stale, reach_sigmas=3.5, backend=backend)
    camera = camera_at(0.0)
    seen = torch.zeros(count, dtype=torch.bool, device=device)
    poses = invert_rigid(camera.world_from_camera)[None]
    mark_seen(blocks, [(camera, poses)], seen, backend=backend)
    return [blocks.low, blocks.high, blocks.reach, seen]


def _adam(backend: Backend, device: torch.device) -> list[Tensor]:
    draw, count = Draw(device), 500
    shapes = ((3,), (4,), (3,), (), (1, 3), (3, 3))
    kept = Parameters(*(draw.normal(count, *shape) for shape in shapes))
    state = AdamState.empty(count, WIDTHS, LEAST, device)
    for _ in range(20):
        rows = (draw.uniform(count) < 0.3).nonzero()[:, 0]
        shown = Parameters(*(torch.zeros_like(value[rows]) for value in kept))
        present_rows(state, kept, rows, shown, backend=backend)
        gradients = Parameters(*(draw.normal(len(rows), *shape) for shape in shapes))
        step_rows(state, kept, rows, shown, gradients, RATES, backend=backend)
    catch_up(state, kept, backend=backend)
    return list(kept)


def _light(backend: Backend, device: torch.device) -> list[Tensor]:
    surfaces, appearance, around, lamps, poses = (moved(part, device) for part in random_scene(500))
    camera = camera_at(-3.0)
    before = camera.camera_from_world.to(device) @ poses
    thrown = irradiance(surfaces, poses, lamps, backend=backend)
    seen = seen_harmonics(
        surfaces, appearance, around, lamps, camera, poses, before, backend=backend
    )
    return [thrown, seen]


def raster(size: tuple[int, int, int], backend: Backend, device: torch.device) -> list[Tensor]:
    """Images of a street-like scene, and the gradients of a loss on them."""
    return draw_and_go_back(raster_scene(size, device), backend)


def raster_scene(size: tuple[int, int, int], device: torch.device) -> dict[str, Any]:
    """A street-like scene of so many Gaussians for images so wide and high."""
    scene = street_like_splats(*size)
    leaves = {name: scene[name].detach().to(device).requires_grad_() for name in LEARNED}
    return scene | leaves | {"body_index": scene["body_index"].to(device)}


def draw_and_go_back(scene: dict[str, Any], backend: Backend) -> list[Tensor]:
    """The images of such a scene, and the gradients of a loss on them."""
    leaves = {name: scene[name] for name in LEARNED}
    splats = Splats(**{name: scene[name] for name in SPLATS})
    image = render_gaussians(splats, scene["camera_from_body"], scene["camera"], backend=backend)
    loss = image.rgb.square().sum() + 0.01 * image.depth_m.sum() + image.alpha.sum()
    gradients = torch.autograd.grad(loss, list(leaves.values()))
    return [image.rgb.detach(), image.depth_m.detach(), image.alpha.detach(), *gradients]


TRIALS = {
    "box_owners": Trial(_boxes, 2e-3),
    "colour_sampling": Trial(_projection, 2e-3),
    "frustum_culling": Trial(_culling, 1e-6),
    "pixel_losses": Trial(_pixel_terms, 1e-4),
    "point_blend": Trial(_blend, 1e-3),
    "point_splat": Trial(_splat, 2e-3),
    "row_motion": Trial(_motion, 1e-4),
    "scene_light": Trial(_light, 1e-3),
    "sky_texture": Trial(_sky, 1e-3),
    "sparse_adam": Trial(_adam, 1e-4),
    "ssim": Trial(_image_loss, 1e-4),
}
"""All but the rasteriser, which has several fast backends."""
RASTER_TOLERANCE: dict[Backend, float] = {"triton": 2e-3, "cuda": 1e-2}
"""A pixel on the alpha cut may fall on either side; gsplat clamps alpha at 0.999 and takes the fast
exponential of the GPU."""
