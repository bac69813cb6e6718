"""Everything a step does per pixel besides the image difference, in one pass each way.

In torch the same work is some twenty passes
over the image and costs as much as drawing a fifth of the Gaussians.
"""

# ruff: noqa: ANN001, ANN202, ANN205, PLR0913 - numba infers these types

import math

import numba
import numpy as np
import torch
from torch import Tensor

from lidarpainter_models.kernels.gaussian_raster import SplatImage
from lidarpainter_models.kernels.pixel_losses import PixelFacts, PixelRules, PixelTerms

_EDGE = 1e-4


@numba.njit(cache=True, nogil=True, parallel=True)
def _forward(rgb, depth, alpha, sky, target, kind, lidar, exposure, tolerances):
    """Image over sky, exposed; sums of both terms; their derivatives by alpha and depth."""
    height, width = alpha.shape
    sky_tolerance, depth_tolerance = tolerances
    shown = np.empty((height, width, 3), np.float32)
    by_alpha = np.empty((height, width, 2), np.float32)  # of the sky term, of the depth term
    by_depth = np.empty((height, width), np.float32)
    sums = np.zeros((height, 3))  # rows by themselves, whatever the number of threads
    for v in numba.prange(height):
        for u in range(width):
            a = alpha[v, u]
            clear = np.float32(1.0) - a
            most = np.float32(0.0)
            for k in range(3):
                light, open_sky = exposure[k, 3], exposure[k, 3]
                for j in range(3):
                    light += exposure[k, j] * (rgb[v, u, j] + clear * sky[v, u, j])
                    open_sky += exposure[k, j] * sky[v, u, j]
                shown[v, u, k] = light
                most = max(most, abs(target[v, u, k] - open_sky))
            by_alpha[v, u, 0], by_alpha[v, u, 1], by_depth[v, u] = 0.0, 0.0, 0.0
            is_sky = kind[v, u] == 1 or (kind[v, u] == 3 and most < sky_tolerance)
            if is_sky or kind[v, u] == 2:
                inside = min(max(a, _EDGE), 1.0 - _EDGE)
                wanted = 1.0 - inside if is_sky else inside
                sums[v, 0] -= math.log(wanted)
                if inside == a:
                    by_alpha[v, u, 0] = 1.0 / wanted if is_sky else -1.0 / wanted
            measured = lidar[v, u]
            if measured > 0 and a > 0.3:
                sums[v, 2] += 1
                error = depth[v, u] / a - measured
                scale = measured * depth_tolerance
                sums[v, 1] += math.log1p(abs(error) / scale)
                slope = math.copysign(1.0, error) / (scale + abs(error)) if error != 0 else 0.0
                by_depth[v, u] = slope / a
                by_alpha[v, u, 1] = -slope * depth[v, u] / (a * a)
    total = sums.sum(axis=0)
    count = max(total[2], 1.0)
    return shown, by_alpha, by_depth, total[0] / (height * width), total[1] / count, count


@numba.njit(cache=True, nogil=True, parallel=True)
def _backward(gradient, rgb, alpha, sky, exposure, by_alpha, by_depth, factors, min_transmittance):
    """Gradients by what is shown; factors are those of both terms, the mean included."""
    height, width = alpha.shape
    to_rgb = np.empty((height, width, 3), np.float32)
    to_alpha = np.empty((height, width), np.float32)
    to_depth = np.empty((height, width), np.float32)
    to_sky = np.empty((height, width, 3), np.float32)
    to_exposure = np.zeros((height, 3, 4))
    sky_factor, depth_factor = factors[0], factors[1]
    for v in numba.prange(height):
        for u in range(width):
            clear = np.float32(1.0) - alpha[v, u]
            total = sky_factor * by_alpha[v, u, 0] + depth_factor * by_alpha[v, u, 1]
            passed = clear if clear > min_transmittance else np.float32(0.0)
            for j in range(3):
                light = np.float32(0.0)
                unexposed = rgb[v, u, j] + clear * sky[v, u, j]
                for k in range(3):
                    light += exposure[k, j] * gradient[v, u, k]
                    to_exposure[v, k, j] += gradient[v, u, k] * unexposed
                to_exposure[v, j, 3] += gradient[v, u, j]
                to_rgb[v, u, j] = light
                to_sky[v, u, j] = light * passed
                total -= light * sky[v, u, j]
            to_alpha[v, u] = total
            to_depth[v, u] = depth_factor * by_depth[v, u]
    return to_rgb, to_alpha, to_depth, to_sky, to_exposure.sum(axis=0).astype(np.float32)


def pixel_terms(
    image: SplatImage, sky_rgb: Tensor, facts: PixelFacts, rules: PixelRules, exposure: Tensor
) -> PixelTerms:
    """See `pixel_losses.pixel_terms`."""
    shown, sky, depth = _PixelTerms.apply(
        image.rgb, image.depth_m, image.alpha, sky_rgb, exposure, facts, rules
    )
    return PixelTerms(shown=shown, sky=sky, depth=depth)


class _PixelTerms(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx,
        rgb: Tensor,
        depth_m: Tensor,
        alpha: Tensor,
        sky_rgb: Tensor,
        exposure: Tensor,
        facts: PixelFacts,
        rules: PixelRules,
    ):
        given = (rgb, depth_m, alpha, sky_rgb, facts.rgb, facts.kind, facts.lidar_depth_m, exposure)
        arrays = [tensor.detach().contiguous().numpy() for tensor in given]
        tolerances = (rules.sky_tolerance, rules.depth_tolerance)
        shown, by_alpha, by_depth, sky_term, depth_term, count = _forward(*(*arrays, tolerances))
        ctx.kept = (arrays[0], arrays[2], arrays[3], arrays[7], by_alpha, by_depth)
        ctx.numbers = (count, rules.min_transmittance)
        return (
            torch.from_numpy(shown),
            torch.tensor(sky_term, dtype=torch.float32),
            torch.tensor(depth_term, dtype=torch.float32),
        )

    @staticmethod
    def backward(ctx, shown_gradient, sky_gradient, depth_gradient):
        count, min_transmittance = ctx.numbers
        pixels = shown_gradient.shape[0] * shown_gradient.shape[1]
        factors = np.array(
            [float(sky_gradient) / pixels, float(depth_gradient) / count], np.float32
        )
        gradient = shown_gradient.contiguous().numpy()
        found = _backward(*(gradient, *ctx.kept, factors, np.float32(min_transmittance)))
        to_rgb, to_alpha, to_depth, to_sky, to_exposure = map(torch.from_numpy, found)
        return to_rgb, to_depth, to_alpha, to_sky, to_exposure, None, None
