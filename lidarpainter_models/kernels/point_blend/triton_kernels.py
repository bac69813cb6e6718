"""Points add their shares to the pixels of their discs."""

import triton
import triton.language as tl

UNITS = tl.constexpr(2.0**38)
"""Units that make up a one in the integer sums."""


@triton.jit(do_not_specialize=["points", "height", "width"])
def scatter_shares(
    uv,
    depth_m,
    attributes,
    surface_m,
    weight,
    radius_px,
    sums,
    tolerance,
    points,
    height,
    width,
    CHANNELS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Add every point, times its share, to the pixels of its disc; shares add up last."""
    point = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    exists = point < points
    u = tl.load(uv + 2 * point, mask=exists, other=-1e9)
    v = tl.load(uv + 2 * point + 1, mask=exists, other=-1e9)
    z = tl.load(depth_m + point, mask=exists, other=float("inf"))
    radius = tl.load(radius_px + point, mask=exists, other=0.0)
    most = tl.load(weight + point, mask=exists, other=0.0)
    # what is no number compares as false
    exists &= (z < float("inf")) & (radius > 0.0) & (tl.abs(u) < 1e8) & (tl.abs(v) < 1e8)
    radius = tl.where(exists, radius, 1.0)
    home_u, home_v = tl.where(exists, tl.floor(u), 0.0), tl.where(exists, tl.floor(v), 0.0)
    reach = tl.max(tl.where(exists, tl.ceil(radius), 0.0).to(tl.int32), axis=0)
    for dv in range(-reach, reach + 1):
        for du in range(-reach, reach + 1):
            x, y = home_u + du, home_v + dv
            inside = exists & (x >= 0) & (x < width) & (y >= 0) & (y < height)
            pixel = tl.where(inside, y, 0.0).to(tl.int64) * width + x.to(tl.int64)
            here = tl.load(surface_m + pixel, mask=inside, other=0.0)
            across, down = x + 0.5 - u, y + 0.5 - v
            square = across * across + down * down
            met = tl.abs(z - here) <= tolerance * here
            taken = inside & (here > 0.0) & met & (square <= radius * radius)
            share = most * tl.exp(-2.0 * square / (radius * radius))
            place = sums + pixel * (CHANNELS + 1)
            for channel in tl.static_range(CHANNELS):
                value = tl.load(attributes + point * CHANNELS + channel, mask=taken, other=0.0)
                part = (share * value * UNITS).to(tl.int64)
                tl.atomic_add(place + channel, part, mask=taken, sem="relaxed")
            part = (share * UNITS).to(tl.int64)
            tl.atomic_add(place + CHANNELS, part, mask=taken, sem="relaxed")
