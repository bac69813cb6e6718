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
from lidarpainter_models.kernels.pixel_losses.pixel_facts import PixelFacts, PixelRules, PixelTerms

_EDGE = 1e-4


@numba.njit(cache=True)
def _forward(rgb, depth, alpha, sky, target, kind, lidar, tolerances):
    """Image over sky; sums of both terms; their derivatives by alpha and depth."""
    height, width = alpha.shape
    sky_tolerance, depth_tolerance = tolerances
    shown = np.empty((height, width, 3), np.float32)
    by_alpha = np.zeros((height, width, 2), np.float32)  # of the sky term, of the depth term
    by_depth = np.zeros((height, width), np.float32)
    sky_sum, depth_sum, count = 0.0, 0.0, 0
    for v in range(height):
        for u in range(width):
            a = alpha[v, u]
            clear = np.float32(1.0) - a
            most = np.float32(0.0)
            for k in range(3):
                shown[v, u, k] = rgb[v, u, k] + clear * sky[v, u, k]
                most = max(most, abs(target[v, u, k] - sky[v, u, k]))
            is_sky = kind[v, u] == 1 or (kind[v, u] == 3 and most < sky_tolerance)
            if is_sky or kind[v, u] == 2:
                inside = min(max(a, _EDGE), 1.0 - _EDGE)
                wanted = 1.0 - inside if is_sky else inside
                sky_sum -= math.log(wanted)
                if inside == a:
                    by_alpha[v, u, 0] = 1.0 / wanted if is_sky else -1.0 / wanted
            measured = lidar[v, u]
            if measured > 0 and a > 0.3:
                count += 1
                error = depth[v, u] / a - measured
                scale = measured * depth_tolerance
                depth_sum += math.log1p(abs(error) / scale)
                slope = math.copysign(1.0, error) / (scale + abs(error)) if error != 0 else 0.0
                by_depth[v, u] = slope / a
                by_alpha[v, u, 1] = -slope * depth[v, u] / (a * a)
    return shown, by_alpha, by_depth, sky_sum / (height * width), depth_sum / max(count, 1), count


@numba.njit(cache=True)
def _backward(gradient, alpha, sky, by_alpha, by_depth, factors, min_transmittance):
    """Gradients by alpha, depth and sky; factors are those of both terms, the mean included."""
    height, width = alpha.shape
    to_alpha = np.empty((height, width), np.float32)
    to_depth = np.empty((height, width), np.float32)
    to_sky = np.zeros((height, width, 3), np.float32)
    sky_factor, depth_factor = factors[0], factors[1]
    for v in range(height):
        for u in range(width):
            clear = np.float32(1.0) - alpha[v, u]
            total = sky_factor * by_alpha[v, u, 0] + depth_factor * by_alpha[v, u, 1]
            for k in range(3):
                total -= gradient[v, u, k] * sky[v, u, k]
            to_alpha[v, u] = total
            to_depth[v, u] = depth_factor * by_depth[v, u]
            if clear > min_transmittance:
                for k in range(3):
                    to_sky[v, u, k] = gradient[v, u, k] * clear
    return to_alpha, to_depth, to_sky


def pixel_terms(
    image: SplatImage, sky_rgb: Tensor, facts: PixelFacts, rules: PixelRules
) -> PixelTerms:
    """See `pixel_losses.pixel_terms`."""
    shown, sky, depth = _PixelTerms.apply(
        image.rgb, image.depth_m, image.alpha, sky_rgb, facts, rules
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
        facts: PixelFacts,
        rules: PixelRules,
    ):
        given = (rgb, depth_m, alpha, sky_rgb, facts.rgb, facts.kind, facts.lidar_depth_m)
        arrays = [tensor.detach().contiguous().numpy() for tensor in given]
        tolerances = (rules.sky_tolerance, rules.depth_tolerance)
        shown, by_alpha, by_depth, sky_term, depth_term, count = _forward(*(*arrays, tolerances))
        ctx.kept = (arrays[2], arrays[3], by_alpha, by_depth, count, rules.min_transmittance)
        return (
            torch.from_numpy(shown),
            torch.tensor(sky_term, dtype=torch.float32),
            torch.tensor(depth_term, dtype=torch.float32),
        )

    @staticmethod
    def backward(ctx, shown_gradient, sky_gradient, depth_gradient):
        alpha, sky, by_alpha, by_depth, count, min_transmittance = ctx.kept
        factors = np.array(
            [float(sky_gradient) / alpha.size, float(depth_gradient) / max(count, 1)], np.float32
        )
        gradient = shown_gradient.contiguous()
        to_alpha, to_depth, to_sky = _backward(
            gradient.numpy(), alpha, sky, by_alpha, by_depth, factors, np.float32(min_transmittance)
        )
        return (
            gradient,
            torch.from_numpy(to_depth),
            torch.from_numpy(to_alpha),
            torch.from_numpy(to_sky),
            None,
            None,
        )
