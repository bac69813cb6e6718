"""Our conventions are gsplat's, as far as gsplat says them in plain torch.

`gsplat.cuda._torch_impl` holds its projection, harmonics and tile lists, and needs no GPU. What its
CUDA functions blend and give back is known from its documentation alone (`documented_gsplat`).
"""

import inspect
from types import ModuleType

import documented_gsplat
import pytest
import torch
from splat_drawing import pinhole, render, split

from lidarpainter_models.kernels.gaussian_raster import cuda
from lidarpainter_models.kernels.gaussian_raster.blending_limits import (
    ALPHA_CUT,
    BLUR_PX2,
    NEAR_M,
    TILE_PX,
)
from lidarpainter_models.kernels.gaussian_raster.reference import harmonic_basis, project_gaussians

law = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is not installed")
wrapper = pytest.importorskip("gsplat.cuda._wrapper", reason="gsplat is not installed")
ROUNDING = 1e-9  # both in float64


def intrinsics(camera):
    return torch.tensor(
        [[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]],
        dtype=torch.float64,
    )


def projected(scene):
    """What both make of the Gaussians that we draw: ours, and gsplat's by name."""
    splats, rest = split(scene)
    camera = rest["camera"]
    screen = project_gaussians(splats, rest["features"], rest["camera_from_body"], camera)
    covariance, _ = law._quat_scale_to_covar_preci(splats.rotation_wxyz, splats.scale_m)
    poses = rest["camera_from_body"]  # each body is a camera to gsplat, which knows one world
    radii, centre_px, depth_m, conics, _ = law._fully_fused_projection(
        splats.means,
        covariance,
        poses,
        intrinsics(camera).expand(len(poses), 3, 3),
        camera.width_px,
        camera.height_px,
        eps2d=BLUR_PX2,
        near_plane=NEAR_M,
    )
    own = (splats.body_index[screen.index], screen.index)
    found = {"radii": radii, "centre_px": centre_px, "depth_m": depth_m, "conics": conics}
    return screen, {name: value[own] for name, value in found.items()}


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_projection_footprint_and_depth_of_several_bodies_are_gsplats(splats, seed):
    screen, found = projected(splats(300, seed=seed, num_bodies=4))
    precision = torch.linalg.inv(screen.covariance_px2)
    conics = torch.stack([precision[:, 0, 0], precision[:, 0, 1], precision[:, 1, 1]], dim=1)
    assert len(screen.index) > 100
    assert torch.allclose(screen.centre_px, found["centre_px"], atol=ROUNDING)
    assert torch.allclose(screen.values[:, 3], found["depth_m"], atol=ROUNDING)
    assert torch.allclose(conics, found["conics"], rtol=1e-9, atol=ROUNDING)


def test_a_gaussian_beside_the_image_is_held_at_the_same_tangent(one_splat):
    scene = one_splat() | {"features": torch.zeros(1, 0).double()}
    scene["means"] = torch.tensor([[2.0, -3.0, 5.0]]).double()  # 40 and 60 px off a 9 px image
    scene["scale_m"] = torch.tensor([[3.0, 2.0, 4.0]]).double()
    screen, found = projected(scene)
    assert torch.allclose(
        torch.linalg.inv(screen.covariance_px2)[0].reshape(-1)[[0, 1, 3]],
        found["conics"][0],
        rtol=1e-9,
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_have_gsplats_order_and_signs(degree):
    directions = torch.nn.functional.normalize(torch.randn(50, 3).double(), dim=1)
    coefficients = torch.randn(50, (degree + 1) ** 2, 3).double()
    ours = torch.einsum("gk,gkc->gc", harmonic_basis(directions, (degree + 1) ** 2), coefficients)
    theirs = law._spherical_harmonics(degree, 3.0 * directions, coefficients)
    assert torch.allclose(ours, theirs, atol=1e-6)  # their constants have fewer digits


def test_the_stand_in_lists_tiles_as_gsplat_does(splats):
    screen = project_gaussians(*_of(splats(60, seed=3)))
    radii = torch.ceil(screen.half_size_px).int()
    depth_m, count = screen.values[:, 3].float(), len(screen.index)
    size = (TILE_PX, 5, 4)
    counts, keys, rows = law._isect_tiles(screen.centre_px[None], radii[None], depth_m[None], *size)
    found = documented_gsplat.isect_tiles(
        screen.centre_px,
        radii,
        depth_m,
        *size,
        packed=True,
        n_images=1,
        image_ids=torch.zeros(count, dtype=torch.long),
        gaussian_ids=screen.index,
    )
    assert torch.equal(found[0], counts[0])
    assert torch.equal(found[1], keys)
    assert torch.equal(found[2], rows)
    offsets = law._isect_offset_encode(keys, 1, *size[1:])
    assert torch.equal(documented_gsplat.isect_offset_encode(keys, 1, *size[1:]), offsets.int())


def _of(scene):
    gaussians, rest = split(scene)
    return gaussians, rest["features"], rest["camera_from_body"], rest["camera"]


def test_every_pixel_that_a_gaussian_reaches_lies_in_a_tile_that_gsplat_lists(splats):
    """The radius handed over is where alpha falls under the cut, not gsplat's 3.33 deviations."""
    scene = splats(40, seed=4, width_px=48, height_px=32) | {"features": torch.zeros(40, 0)}
    scene["opacity"] = scene["opacity"].clamp(max=0.98)
    screen = project_gaussians(*_of(scene))
    radii = torch.ceil(screen.half_size_px).int()
    _, keys, rows = law._isect_tiles(
        screen.centre_px[None], radii[None], screen.values[None, :, 3].float(), TILE_PX, 3, 2
    )
    listed = torch.zeros(len(radii), 6, dtype=torch.bool)
    listed[rows.long(), keys >> 32] = True
    alpha = _alpha_of_pixels(screen, 48, 32).reshape(-1, 2, TILE_PX, 3, TILE_PX)
    reached = (alpha >= ALPHA_CUT).any(dim=4).any(dim=2).reshape(-1, 6)
    assert bool(reached.any())
    assert not bool((reached & ~listed).any())


def _alpha_of_pixels(screen, width_px, height_px):
    """Alpha of each Gaussian at each pixel centre, (gaussians, pixels)."""
    y, x = torch.meshgrid(torch.arange(height_px), torch.arange(width_px), indexing="ij")
    pixels = torch.stack([x, y], dim=-1).reshape(1, -1, 2) + 0.5
    offset = pixels - screen.centre_px[:, None]
    precision = torch.linalg.inv(screen.covariance_px2)
    power = 0.5 * torch.einsum("gpi,gij,gpj->gp", offset, precision, offset)
    return screen.opacity[:, None] * torch.exp(-power)


def test_the_adapter_draws_the_law_with_gsplats_own_lists(splats):
    def isect_tiles(centre_px, radii, depth_m, *size, packed, n_images, image_ids, gaussian_ids):
        assert packed
        assert n_images == 1
        assert len(image_ids) == len(gaussian_ids)
        counts, keys, rows = law._isect_tiles(centre_px[None], radii[None], depth_m[None], *size)
        return counts[0], keys, rows

    gsplat = ModuleType("gsplat")
    gsplat.isect_tiles = isect_tiles
    gsplat.isect_offset_encode = law._isect_offset_encode
    gsplat.rasterize_to_pixels = documented_gsplat.rasterize_to_pixels
    scene = splats(60, seed=8, features=1)
    scene["opacity"] = scene["opacity"].clamp(max=0.98)
    gaussians, features, poses, camera = _of(scene)
    rgb, depth_m, _, _, visible = cuda.draw_with(gsplat, gaussians, features, poses, camera, None)
    image = render(scene, backend="reference")
    assert float((rgb - image.rgb).abs().mean()) < 1e-6
    assert float((depth_m - image.depth_m).abs().mean()) < 1e-5
    assert torch.equal(visible, image.visible)


@pytest.mark.parametrize("name", ["isect_tiles", "isect_offset_encode", "rasterize_to_pixels"])
def test_the_stand_in_takes_what_gsplat_takes(name):
    ours = inspect.signature(getattr(documented_gsplat, name)).parameters
    theirs = inspect.signature(getattr(wrapper, name)).parameters
    assert set(ours) <= set(theirs)
    by_place = [key for key, value in ours.items() if value.default is inspect.Parameter.empty]
    assert by_place == list(theirs)[: len(by_place)]
    assert all(ours[key].default == theirs[key].default for key in ours)


def test_the_camera_is_a_plain_pinhole():
    """Pixel centres at one half: the axis of a lens centred at cx meets the pixel at cx - 0.5."""
    camera = pinhole(fx_px=10.0, fy_px=10.0, cx_px=4.5, cy_px=2.5, width_px=9, height_px=5)
    centre_px, _ = law._persp_proj(
        torch.tensor([[[0.0, 0.0, 3.0]]]).double(),
        torch.eye(3).double().expand(1, 1, 3, 3),
        intrinsics(camera)[None],
        9,
        5,
    )
    assert centre_px[0, 0].tolist() == [4.5, 2.5]
