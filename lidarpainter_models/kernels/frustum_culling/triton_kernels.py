"""Triton kernels of frustum culling; `triton.py` launches them. One program a block."""

import triton
import triton.language as tl

LANES = tl.constexpr(128)
"""Gaussians of a block that are looked at together."""
PLANES = tl.constexpr(5)
PLANE_FLOATS = tl.constexpr(5)
VIEW_FLOATS = tl.constexpr(26)
"""Numbers of a view: its planes, then how many metres actors may still move."""


@triton.jit
def bound_blocks(order, first, is_stale, means, log_scale, reach_sigmas, low, high, reach):
    """Bounds of the stale blocks; a Gaussian that is not finite is never drawn and has none."""
    block = tl.program_id(0).to(tl.int64)
    if tl.load(is_stale + block):
        largest = tl.full([LANES], float("-inf"), tl.float32)
        low_x, high_x = -largest, largest
        low_y, high_y = -largest, largest
        low_z, high_z = -largest, largest
        end = tl.load(first + block + 1)
        for start in range(tl.load(first + block), end, LANES):
            place = start + tl.arange(0, LANES)
            row = 3 * tl.load(order + place, mask=place < end, other=0)
            x, y, z = tl.load(means + row), tl.load(means + row + 1), tl.load(means + row + 2)
            size = tl.load(log_scale + row)
            for axis in tl.static_range(1, 3):
                other = tl.load(log_scale + row + axis)
                size = tl.maximum(size, other, propagate_nan=tl.PropagateNan.ALL)
            counts = (place < end) & (tl.abs(x + y + z + size) < float("inf"))
            largest = tl.where(counts, tl.maximum(largest, size), largest)
            low_x = tl.where(counts, tl.minimum(low_x, x), low_x)
            low_y = tl.where(counts, tl.minimum(low_y, y), low_y)
            low_z = tl.where(counts, tl.minimum(low_z, z), low_z)
            high_x = tl.where(counts, tl.maximum(high_x, x), high_x)
            high_y = tl.where(counts, tl.maximum(high_y, y), high_y)
            high_z = tl.where(counts, tl.maximum(high_z, z), high_z)
        tl.store(low + 3 * block, tl.min(low_x).to(tl.float64))
        tl.store(low + 3 * block + 1, tl.min(low_y).to(tl.float64))
        tl.store(low + 3 * block + 2, tl.min(low_z).to(tl.float64))
        tl.store(high + 3 * block, tl.max(high_x).to(tl.float64))
        tl.store(high + 3 * block + 1, tl.max(high_y).to(tl.float64))
        tl.store(high + 3 * block + 2, tl.max(high_z).to(tl.float64))
        size_m = tl.exp(tl.max(largest).to(tl.float64))
        tl.store(reach + block, tl.load(reach_sigmas) * size_m)


@triton.jit
def _column(pose, axis, facing):
    """How much each plane's distance changes along an axis of the body; 3: where it lies."""
    return (
        facing[0] * tl.load(pose + axis)
        + facing[1] * tl.load(pose + 4 + axis)
        + facing[2] * tl.load(pose + 8 + axis)
    )


@triton.jit
def _is_in_view(view, pose, is_actor, low, high, reach):
    """Whether a box of centres may hold a Gaussian that reaches into the view."""
    side = tl.arange(0, 8)
    plane, is_plane = view + PLANE_FLOATS * side, side < PLANES
    facing = (
        tl.load(plane, mask=is_plane, other=0.0),
        tl.load(plane + 1, mask=is_plane, other=0.0),
        tl.load(plane + 2, mask=is_plane, other=0.0),
    )
    stretch = tl.load(plane + 3, mask=is_plane, other=0.0)
    outside = _column(pose, 3, facing) + tl.load(plane + 4, mask=is_plane, other=0.0)
    for axis in tl.static_range(3):
        slope = _column(pose, axis, facing)
        middle, half = (low[axis] + high[axis]) * 0.5, (high[axis] - low[axis]) * 0.5
        outside += slope * middle - tl.abs(slope) * half  # the corner that is least outside
    slack_m = tl.load(view + PLANES * PLANE_FLOATS)
    reach += tl.where(is_actor, slack_m, 0.0)
    reaches_in = outside <= reach * stretch
    return tl.min(tl.where(reaches_in | (side >= PLANES), 1, 0)) == 1


@triton.jit(do_not_specialize=["num_views", "num_bodies"])
def mark_blocks(order, first, body, low, high, reach, views, is_seen, num_views, num_bodies):
    """Mark the rows of all blocks in any of the views."""
    block = tl.program_id(0).to(tl.int64)
    own = tl.load(body + block).to(tl.int64)
    corner_low, corner_high, reach_m = low + 3 * block, high + 3 * block, tl.load(reach + block)
    lowest = (tl.load(corner_low), tl.load(corner_low + 1), tl.load(corner_low + 2))
    highest = (tl.load(corner_high), tl.load(corner_high + 1), tl.load(corner_high + 2))
    sees, poses = own < 0, views + VIEW_FLOATS * num_views  # poses lie behind all views' numbers
    for number in range(num_views):
        view, pose = views + VIEW_FLOATS * number, poses + 16 * (number * num_bodies + own)
        sees = sees | _is_in_view(view, pose, own > 0, lowest, highest, reach_m)
    begin = tl.load(first + block)
    end = tl.where(sees & (lowest[0] <= highest[0]), tl.load(first + block + 1), begin)
    for start in range(begin, end, LANES):
        place = start + tl.arange(0, LANES)
        row = tl.load(order + place, mask=place < end, other=0)
        tl.store(is_seen + row, place < end, mask=place < end)
