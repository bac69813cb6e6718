"""The terms of a drawn image as Triton kernels, a block of pixels a program.

Terms are judged in float64, as `cpu.py` does: a logarithm near the edge of alpha keeps its digits.
"""

import triton
import triton.language as tl

from lidarpainter_models.kernels import pixel_losses
from lidarpainter_models.kernels.pixel_losses.reference import ALPHA_EDGE, LEAST_KNOWN_ALPHA

SKY, SOLID = tl.constexpr(pixel_losses.SKY), tl.constexpr(pixel_losses.SOLID)
OPEN = tl.constexpr(pixel_losses.OPEN)
EDGE, KNOWN = tl.constexpr(ALPHA_EDGE), tl.constexpr(LEAST_KNOWN_ALPHA)
TERMS = tl.constexpr(3)
"""Sums of a program: the sky's term, that of depth, and the pixels with known depth."""
MATRIX = tl.constexpr(12)
"""Numbers of an exposure."""


@triton.jit
def colour(image, pixel, inside):
    """Red, green and blue of pixels."""
    place = image + pixel * 3
    return (
        tl.load(place, mask=inside, other=0.0),
        tl.load(place + 1, mask=inside, other=0.0),
        tl.load(place + 2, mask=inside, other=0.0),
    )


@triton.jit
def store_colour(image, pixel, inside, red, green, blue):
    """Write red, green and blue of pixels."""
    tl.store(image + pixel * 3, red, mask=inside)
    tl.store(image + pixel * 3 + 1, green, mask=inside)
    tl.store(image + pixel * 3 + 2, blue, mask=inside)


@triton.jit
def exposed(exposure, row: tl.constexpr, red, green, blue):
    """One channel of a colour as a camera shows it."""
    shown = tl.load(exposure + 4 * row) * red + tl.load(exposure + 4 * row + 1) * green
    return shown + tl.load(exposure + 4 * row + 2) * blue + tl.load(exposure + 4 * row + 3)


@triton.jit
def looks_like_sky(target, pixel, inside, exposure, sky, tolerance):
    """Whether pixels have the colour of the sky behind them, as the camera shows it."""
    red, green, blue = colour(target, pixel, inside)
    is_near = tl.abs(red - exposed(exposure, 0, sky[0], sky[1], sky[2])) < tolerance
    is_near &= tl.abs(green - exposed(exposure, 1, sky[0], sky[1], sky[2])) < tolerance
    return is_near & (tl.abs(blue - exposed(exposure, 2, sky[0], sky[1], sky[2])) < tolerance)


@triton.jit
def sky_term(alpha, kind, like_sky):
    """-log of the share wanted, and its slope by alpha; both float64, 0 where neither is wanted."""
    is_sky = (kind == SKY) | ((kind == OPEN) & like_sky)
    drawn = alpha.to(tl.float64)
    low, high = tl.full(alpha.shape, EDGE, tl.float64), tl.full(alpha.shape, 1.0 - EDGE, tl.float64)
    held = tl.where(drawn < low, low, tl.where(drawn > high, high, drawn))
    wanted = tl.where(is_sky, 1.0 - held, held)
    counts = is_sky | (kind == SOLID)
    slope = tl.where(is_sky, 1.0, -1.0) / wanted
    slope = tl.where(counts & (held == drawn), slope, 0.0)
    return tl.where(counts, -tl.log(wanted), 0.0), slope


@triton.jit
def depth_term(depth, alpha, measured, tolerance):
    """log(1 + e / tolerance), its slopes by depth and alpha, and whether the depth is known."""
    known = (measured > 0.0) & (alpha > KNOWN)
    drawn, light = depth.to(tl.float64), tl.where(known, alpha, 1.0).to(tl.float64)
    truth = tl.where(known, measured, 1.0).to(tl.float64)
    error, scale = drawn / light - truth, truth * tolerance
    far = tl.abs(error)
    sign = (error > 0.0).to(tl.float64) - (error < 0.0).to(tl.float64)
    by_depth = sign / (scale + far) / light
    by_alpha = -by_depth * drawn / light
    return (
        tl.where(known, tl.log(1.0 + far / scale), 0.0),
        tl.where(known, by_depth, 0.0),
        tl.where(known, by_alpha, 0.0),
        known,
    )


@triton.jit(do_not_specialize=["pixels"])
def judge(
    rgb,
    depth,
    alpha,
    sky,
    target,
    kind,
    lidar,
    exposure,
    shown,
    sums,
    pixels,
    sky_tolerance,
    depth_tolerance,
    BLOCK: tl.constexpr,
):
    """Show the image over its sky, and sum both terms over the program's pixels."""
    program = tl.program_id(0)
    pixel = program.to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < pixels
    light = tl.load(alpha + pixel, mask=inside, other=0.0)
    red, green, blue = colour(rgb, pixel, inside)
    behind = colour(sky, pixel, inside)
    clear = 1.0 - light
    red, green, blue = red + clear * behind[0], green + clear * behind[1], blue + clear * behind[2]
    store_colour(
        shown,
        pixel,
        inside,
        exposed(exposure, 0, red, green, blue),
        exposed(exposure, 1, red, green, blue),
        exposed(exposure, 2, red, green, blue),
    )
    like_sky = looks_like_sky(target, pixel, inside, exposure, behind, sky_tolerance)
    of_sky, _ = sky_term(light, tl.load(kind + pixel, mask=inside, other=0), like_sky)
    measured = tl.load(lidar + pixel, mask=inside, other=0.0)
    far = tl.load(depth + pixel, mask=inside, other=0.0)
    of_depth, _, _, known = depth_term(far, light, measured, depth_tolerance)
    tl.store(sums + program * TERMS, tl.sum(of_sky))
    tl.store(sums + program * TERMS + 1, tl.sum(of_depth))
    tl.store(sums + program * TERMS + 2, tl.sum(known.to(tl.float64)))


@triton.jit(do_not_specialize=["programs", "pixels"])
def means(sums, sky_mean, depth_mean, known, programs, pixels, BLOCK: tl.constexpr):
    """The mean of each term from the sums of all programs, in their order; one program."""
    none = tl.zeros([BLOCK], tl.float64)
    of_sky, of_depth, count = none, none, none
    for first in range(0, programs, BLOCK):
        program = first + tl.arange(0, BLOCK)
        inside, place = program < programs, sums + program * TERMS
        of_sky += tl.load(place, mask=inside, other=0.0)
        of_depth += tl.load(place + 1, mask=inside, other=0.0)
        count += tl.load(place + 2, mask=inside, other=0.0)
    all_known = tl.sum(count)
    all_known = tl.where(all_known > 1.0, all_known, 1.0)
    tl.store(sky_mean, (tl.sum(of_sky) / pixels).to(tl.float32))
    tl.store(depth_mean, (tl.sum(of_depth) / all_known).to(tl.float32))
    tl.store(known, all_known)


@triton.jit(do_not_specialize=["pixels"])
def unjudge(
    rgb,
    depth,
    alpha,
    sky,
    target,
    kind,
    lidar,
    exposure,
    known,
    from_shown,
    from_sky,
    from_depth,
    to_rgb,
    to_depth,
    to_alpha,
    to_sky,
    to_exposure,
    pixels,
    sky_tolerance,
    depth_tolerance,
    min_transmittance,
    BLOCK: tl.constexpr,
):
    """The gradients of each pixel, and of the exposure the sums over the program's pixels."""
    program = tl.program_id(0)
    pixel = program.to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < pixels
    light = tl.load(alpha + pixel, mask=inside, other=0.0)
    behind = colour(sky, pixel, inside)
    above = colour(from_shown, pixel, inside)
    like_sky = looks_like_sky(target, pixel, inside, exposure, behind, sky_tolerance)
    _, slope = sky_term(light, tl.load(kind + pixel, mask=inside, other=0), like_sky)
    measured = tl.load(lidar + pixel, mask=inside, other=0.0)
    far = tl.load(depth + pixel, mask=inside, other=0.0)
    _, by_depth, by_alpha, _ = depth_term(far, light, measured, depth_tolerance)
    depth_factor = tl.load(from_depth) / tl.load(known)
    tl.store(to_depth + pixel, (depth_factor * by_depth).to(tl.float32), mask=inside)
    total = tl.load(from_sky).to(tl.float64) / pixels * slope + depth_factor * by_alpha
    clear = 1.0 - light
    passed = tl.where(clear > min_transmittance, clear, 0.0)
    for j in tl.static_range(3):
        wanted = tl.load(exposure + j) * above[0] + tl.load(exposure + 4 + j) * above[1]
        wanted += tl.load(exposure + 8 + j) * above[2]
        tl.store(to_rgb + pixel * 3 + j, wanted, mask=inside)
        tl.store(to_sky + pixel * 3 + j, wanted * passed, mask=inside)
        total -= (wanted * behind[j]).to(tl.float64)
        unexposed = tl.load(rgb + pixel * 3 + j, mask=inside, other=0.0) + clear * behind[j]
        for k in tl.static_range(3):
            share = tl.sum((above[k] * unexposed).to(tl.float64))
            tl.store(to_exposure + program * MATRIX + 4 * k + j, share)
        tl.store(to_exposure + program * MATRIX + 4 * j + 3, tl.sum(above[j].to(tl.float64)))
    tl.store(to_alpha + pixel, total.to(tl.float32), mask=inside)
