"""Points claim the pixels of their discs."""

import triton
import triton.language as tl


@triton.jit(do_not_specialize=["points", "height", "width"])
def claim_discs(pixels, depth_m, radius_px, keys, points, height, width, BLOCK: tl.constexpr):
    """Lower the key of every pixel of a disc to that of its point."""
    point = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    exists = point < points
    u = tl.load(pixels + 2 * point, mask=exists, other=-1e9)
    v = tl.load(pixels + 2 * point + 1, mask=exists, other=-1e9)
    z = tl.load(depth_m + point, mask=exists, other=0.0)
    radius = tl.load(radius_px + point, mask=exists, other=0).to(tl.int32)
    # what is no number compares as false
    seen = exists & (z > 0.0) & (z < float("inf")) & (tl.abs(u) < 1e8) & (tl.abs(v) < 1e8)
    column, row = tl.where(seen, u, 0.0).to(tl.int32), tl.where(seen, v, 0.0).to(tl.int32)
    key = (z.to(tl.int32, bitcast=True).to(tl.int64) << 32) | point.to(tl.int64)
    reach = tl.max(tl.where(seen, radius, 0), axis=0)
    for dv in range(-reach, reach + 1):
        for du in range(-reach, reach + 1):
            x, y = column + du, row + dv
            covers = seen & (du * du + dv * dv <= radius * (radius + 1))
            covers &= (x >= 0) & (x < width) & (y >= 0) & (y < height)
            tl.atomic_min(keys + y.to(tl.int64) * width + x, key, mask=covers, sem="relaxed")
