"""Fast sky texture look-ups on a CPU: sampling, its transpose, and Adam on the texels touched.

A dense Adam over the texture would cost more
than the look-ups themselves; here only texels that received a gradient are visited. What sums over
pixels is serial, so everything is bitwise repeatable.
"""

# ruff: noqa: ANN001, ANN202 - numba infers these types

import math

import numba
import numpy as np
import torch
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.sky_texture import SkyLayout, SkyRays, TexelMoments

_HALF_PI = np.float32(math.pi / 2)
_PI = np.float32(math.pi)
_TURN = np.float32(2 * math.pi)
_MOST_VISITS = 1000
"""Visits of a texel that are counted: afterwards Adam's biases are gone."""


def locate(camera: Camera, layout: SkyLayout, wanted: Tensor) -> Tensor:
    """See `sky_texture.sky_rays`."""
    lens = torch.tensor([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]).float()
    extent = torch.tensor(
        [layout.azimuth_left_rad, layout.elevation_top_rad, layout.texel_rad, layout.columns]
    ).float()
    rotation = camera.world_from_camera[:3, :3].detach().float().contiguous()
    places = _locate(rotation.numpy(), lens.numpy(), extent.numpy(), wanted.contiguous().numpy())
    return torch.from_numpy(places)


def sample(texture: Tensor, rays: SkyRays, layout: SkyLayout) -> Tensor:
    """See `sky_texture.sample_sky`."""
    wanted = rays.wanted.contiguous().numpy()
    return torch.from_numpy(_sample(texture.numpy(), rays.places.numpy(), wanted, layout.wraps))


def scatter(
    gradient: Tensor, weight: Tensor, rays: SkyRays, layout: SkyLayout
) -> tuple[Tensor, Tensor]:
    """See `sky_texture.scatter_gradient`."""
    texel_gradient, texel_weight = _scatter(
        (layout.rows, layout.columns),
        rays.places.numpy(),
        gradient.contiguous().numpy(),
        weight.contiguous().numpy(),
        layout.wraps,
    )
    return torch.from_numpy(texel_gradient), torch.from_numpy(texel_weight)


def adam(
    texture: Tensor, moments: TexelMoments, gradient: Tensor, weight: Tensor, learning_rate: float
) -> None:
    """See `sky_texture.step_texels`."""
    _adam(
        texture.numpy(),
        moments.first.numpy(),
        moments.second.numpy(),
        moments.visits.numpy(),
        gradient.numpy(),
        weight.numpy(),
        learning_rate,
    )


@numba.njit(cache=True, nogil=True, inline="always")
def _atan2(y, x):
    """Arc tangent by the odd polynomial of degree 11 on [0, 1]; error under 2e-6 rad."""
    smaller, larger = min(abs(y), abs(x)), max(abs(y), abs(x))
    a = smaller / max(larger, np.float32(1e-20))
    s = a * a
    r = np.float32(-0.01172120) * s + np.float32(0.05265332)
    r = r * s + np.float32(-0.11643287)
    r = r * s + np.float32(0.19354346)
    r = r * s + np.float32(-0.33262347)
    r = (r * s + np.float32(0.99997726)) * a
    if abs(y) > abs(x):
        r = _HALF_PI - r
    if x < 0:
        r = _PI - r
    return -r if y < 0 else r


@numba.njit(cache=True, nogil=True, parallel=True)
def _locate(world_from_camera, lens, layout, wanted):
    """Continuous (column, row) in the texture of the wanted pixels' rays, texel centres at +0.5.

    lens: fx, fy, cx, cy in pixels. layout: azimuth of the left edge, elevation of the top edge,
    texel size (radians), number of columns.
    """
    height, width = wanted.shape
    places = np.zeros((height, width, 2), np.float32)
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    left, top, texel, columns = layout[0], layout[1], layout[2], layout[3]
    margin = (_TURN - columns * texel) * np.float32(0.5)
    for v in numba.prange(height):
        y = (np.float32(v + 0.5) - cy) / fy
        for u in range(width):
            if not wanted[v, u]:
                continue
            x = (np.float32(u + 0.5) - cx) / fx
            dx = world_from_camera[0, 0] * x + world_from_camera[0, 1] * y + world_from_camera[0, 2]
            dy = world_from_camera[1, 0] * x + world_from_camera[1, 1] * y + world_from_camera[1, 2]
            dz = world_from_camera[2, 0] * x + world_from_camera[2, 1] * y + world_from_camera[2, 2]
            turn = left - _atan2(dy, dx)
            # into [-margin, turn - margin): directions outside a crop go to its nearer edge
            if turn < -margin:
                turn += _TURN
            elif turn >= _TURN - margin:
                turn -= _TURN
            places[v, u, 0] = turn / texel
            places[v, u, 1] = (top - _atan2(dz, math.sqrt(dx * dx + dy * dy))) / texel
    return places


@numba.njit(cache=True, nogil=True, inline="always")
def _corners(column, row, columns, rows, wraps):
    """The four texels around a place and the weights of the second column and row."""
    column -= np.float32(0.5)
    row = min(max(row - np.float32(0.5), np.float32(0.0)), np.float32(rows - 1))
    if not wraps:
        column = min(max(column, np.float32(0.0)), np.float32(columns - 1))
    c0, r0 = math.floor(column), math.floor(row)
    wc, wr = column - np.float32(c0), row - np.float32(r0)
    c1 = c0 + 1
    if wraps:
        c0, c1 = c0 % columns, c1 % columns
    else:
        c1 = min(c1, columns - 1)
    return c0, c1, r0, min(r0 + 1, rows - 1), wc, wr


@numba.njit(cache=True, nogil=True, parallel=True)
def _sample(texture, places, wanted, wraps):
    """Bilinear colours at the places of the wanted pixels, black elsewhere."""
    rows, columns = texture.shape[:2]
    height, width = places.shape[:2]
    rgb = np.zeros((height, width, 3), np.float32)
    one = np.float32(1.0)
    for v in numba.prange(height):
        for u in range(width):
            if not wanted[v, u]:
                continue
            c0, c1, r0, r1, wc, wr = _corners(
                places[v, u, 0], places[v, u, 1], columns, rows, wraps
            )
            for k in range(3):
                upper = (one - wc) * texture[r0, c0, k] + wc * texture[r0, c1, k]
                lower = (one - wc) * texture[r1, c0, k] + wc * texture[r1, c1, k]
                rgb[v, u, k] = (one - wr) * upper + wr * lower
    return rgb


@numba.njit(cache=True, nogil=True)
def _scatter(shape, places, gradient, weight, wraps):
    """Transpose of `sample` on pixels of positive weight: texel gradients and summed weights."""
    rows, columns = shape
    texel_gradient = np.zeros((rows, columns, 3), np.float32)
    texel_weight = np.zeros((rows, columns), np.float32)
    one = np.float32(1.0)
    for v in range(places.shape[0]):
        for u in range(places.shape[1]):
            w = weight[v, u]
            if w <= 0:
                continue
            c0, c1, r0, r1, wc, wr = _corners(
                places[v, u, 0], places[v, u, 1], columns, rows, wraps
            )
            for r, c, share in (
                (r0, c0, (one - wr) * (one - wc)),
                (r0, c1, (one - wr) * wc),
                (r1, c0, wr * (one - wc)),
                (r1, c1, wr * wc),
            ):
                texel_weight[r, c] += share * w
                for k in range(3):
                    texel_gradient[r, c, k] += share * gradient[v, u, k]
    return texel_gradient, texel_weight


@numba.njit(cache=True, nogil=True, parallel=True)
def _adam(texture, first, second, visits, gradient, weight, rate):
    """One Adam step in place on every texel of positive weight, each with its own step count."""
    beta1, beta2 = np.float32(0.9), np.float32(0.99)
    one, epsilon = np.float32(1.0), np.float32(1e-12)
    rows, columns = weight.shape
    fixes = np.empty((_MOST_VISITS + 1, 2), np.float32)
    for count in range(_MOST_VISITS + 1):  # powers are too slow for every texel
        fixes[count, 0] = one - beta1 ** np.float32(count)
        fixes[count, 1] = one - beta2 ** np.float32(count)
    for r in numba.prange(rows):
        for c in range(columns):
            if weight[r, c] <= 0:
                continue
            visits[r, c] += 1
            fix1, fix2 = fixes[min(visits[r, c], _MOST_VISITS)]
            for k in range(3):
                g = gradient[r, c, k]
                m = beta1 * first[r, c, k] + (one - beta1) * g
                s = beta2 * second[r, c, k] + (one - beta2) * g * g
                first[r, c, k], second[r, c, k] = m, s
                step = rate * (m / fix1) / (math.sqrt(s / fix2) + epsilon)
                texture[r, c, k] = min(max(texture[r, c, k] - step, np.float32(0.0)), one)
