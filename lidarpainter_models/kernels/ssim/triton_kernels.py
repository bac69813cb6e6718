"""SSIM as Triton kernels: each program goes down a strip of columns and blurs both ways on the way.

The equations are those of `cpu.py`. A row of interleaved channels is blurred along itself and added
to eleven rows of sums, with the weight of each; the topmost is done by then. Ten wait for more.
"""

import triton
import triton.language as tl

from lidarpainter_models.kernels.ssim import reference

CHANNELS = tl.constexpr(3)
RADIUS = tl.constexpr(reference.WINDOW_RADIUS_PX)
TAPS = tl.constexpr(2 * reference.WINDOW_RADIUS_PX + 1)
# the window is symmetric: its centre and then one side
W0, W1, W2, W3, W4, W5 = map(tl.constexpr, reference.window_weights()[RADIUS.value :])
WINDOW = tl.constexpr(reference.window_weights())
C1 = tl.constexpr(reference.LUMINANCE_CONSTANT)
C2 = tl.constexpr(reference.CONTRAST_CONSTANT)


@triton.jit
def pixels(first, second, weight, row, column, width, WEIGHTED: tl.constexpr):
    """Both images and the weight along a row, zero outside; where that is 0 the second twice."""
    inside = (column >= 0) & (column < width * CHANNELS)
    start = row.to(tl.int64) * width
    one = tl.load(first + start * CHANNELS + column, mask=inside, other=0.0)
    other = tl.load(second + start * CHANNELS + column, mask=inside, other=0.0)
    trust = 1.0
    if WEIGHTED:
        trust = tl.load(weight + start + column // CHANNELS, mask=inside, other=0.0)
        one = tl.where(trust > 0.0, one, other)
    return one, other, trust


@triton.jit
def none_waiting(none):
    """The sums of ten rows before any is added."""
    return none, none, none, none, none, none, none, none, none, none


@triton.jit
def pushed(waiting, value):
    """The sum that a row's value completes, and the ten that wait for the next row."""
    done = waiting[0] + value * W5
    left = (
        waiting[1] + value * W4,
        waiting[2] + value * W3,
        waiting[3] + value * W2,
        waiting[4] + value * W1,
        waiting[5] + value * W0,
        waiting[6] + value * W1,
        waiting[7] + value * W2,
        waiting[8] + value * W3,
        waiting[9] + value * W4,
        value * W5,
    )
    return done, left


@triton.jit
def similarity_of(mean_d, mean_s, mean_dd, mean_ss):
    """1 - SSIM, and the three derivatives of SSIM: by the means as such, by DD and by SS."""
    square_d, full_s = mean_d * mean_d, mean_s + 1.0
    variance_d, variance_s = mean_dd - square_d, mean_ss - mean_s * mean_s
    inverse_m = 1.0 / (0.5 * (full_s * full_s + square_d) + C1)
    inverse_v = 1.0 / (0.5 * (variance_s + variance_d) + C2)
    a, b = square_d * inverse_m, variance_d * inverse_v
    by_mean = inverse_m * (mean_d * (2.0 - a) - a * full_s)
    by_b = (a - 1.0) * inverse_v
    by_means = (b - 1.0) * by_mean + by_b * (b * (mean_d + mean_s) - 2.0 * mean_d)
    return a + b - a * b, by_means, by_b * (1.0 - 0.5 * b), -0.5 * b * by_b


@triton.jit(do_not_specialize=["height", "width"])
def compare(
    first,
    second,
    weight,
    similarity,
    sums,
    partials,
    height,
    width,
    ssim_weight,
    scale,
    IS_MAP: tl.constexpr,
    WEIGHTED: tl.constexpr,
    WITH_PARTIALS: tl.constexpr,
    ROWS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """The SSIM map, or each program's share of the loss; weighted derivatives for `spread`."""
    column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    top = tl.program_id(1) * ROWS
    length, within = width * CHANNELS, column < width * CHANNELS
    none = tl.zeros([BLOCK], tl.float32)
    rows_d, rows_s = none_waiting(none), none_waiting(none)
    rows_dd, rows_ss = none_waiting(none), none_waiting(none)
    loss = tl.zeros([BLOCK], tl.float64)
    for step in range(tl.minimum(ROWS, height - top) + 2 * RADIUS):
        row = top + step - RADIUS
        d, s, dd, ss = none, none - 1.0, none, none + 1.0  # of black rows
        if (row >= 0) & (row < height):
            s, ss = none, none
            for tap in tl.static_range(TAPS):
                across = column + (tap - RADIUS) * CHANNELS
                one, other, _ = pixels(first, second, weight, row, across, width, WEIGHTED)
                difference, total = one - other, one + other - 1.0
                d += difference * WINDOW[tap]
                s += total * WINDOW[tap]
                dd += difference * difference * WINDOW[tap]
                ss += total * total * WINDOW[tap]
        mean_d, rows_d = pushed(rows_d, d)
        mean_s, rows_s = pushed(rows_s, s)
        mean_dd, rows_dd = pushed(rows_dd, dd)
        mean_ss, rows_ss = pushed(rows_ss, ss)
        done = row - RADIUS
        if done >= top:
            one, other, trust = pixels(first, second, weight, done, column, width, WEIGHTED)
            unlike, by_means, by_dd, by_ss = similarity_of(mean_d, mean_s, mean_dd, mean_ss)
            place = done.to(tl.int64) * length + column
            if IS_MAP:
                tl.store(similarity + place, 1.0 - unlike, mask=within)
            else:
                loss += (trust * tl.abs(one - other)).to(tl.float64)
                loss += (ssim_weight * (trust * unlike)).to(tl.float64)
            if WITH_PARTIALS:
                plane = height.to(tl.int64) * length
                tl.store(partials + place, trust * by_means, mask=within)
                tl.store(partials + plane + place, trust * by_dd, mask=within)
                tl.store(partials + 2 * plane + place, trust * by_ss, mask=within)
    if not IS_MAP:
        program = tl.program_id(1) * tl.num_programs(0) + tl.program_id(0)
        tl.store(sums + program, scale * tl.sum(tl.where(within, loss, 0.0)))


@triton.jit(do_not_specialize=["height", "width"])
def spread(
    first,
    second,
    weight,
    partials,
    upstream,
    gradient,
    height,
    width,
    ssim_weight,
    scale,
    IS_MAP: tl.constexpr,
    WEIGHTED: tl.constexpr,
    ROWS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """The gradient to the first image from that of each entry of the map, or of the loss."""
    column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    top = tl.program_id(1) * ROWS
    length, plane = width * CHANNELS, height.to(tl.int64) * width * CHANNELS
    none = tl.zeros([BLOCK], tl.float32)
    rows_mean, rows_dd, rows_ss = none_waiting(none), none_waiting(none), none_waiting(none)
    for step in range(tl.minimum(ROWS, height - top) + 2 * RADIUS):
        row = top + step - RADIUS
        mean, dd, ss = none, none, none
        if (row >= 0) & (row < height):
            start = row.to(tl.int64) * length
            for tap in tl.static_range(TAPS):
                across = column + (tap - RADIUS) * CHANNELS
                inside = (across >= 0) & (across < length)
                share = WINDOW[tap]
                if IS_MAP:
                    share = tl.load(upstream + start + across, mask=inside, other=0.0) * share
                place = partials + start + across
                mean += tl.load(place, mask=inside, other=0.0) * share
                dd += tl.load(place + plane, mask=inside, other=0.0) * share
                ss += tl.load(place + 2 * plane, mask=inside, other=0.0) * share
        by_means, rows_mean = pushed(rows_mean, mean)
        by_dd, rows_dd = pushed(rows_dd, dd)
        by_ss, rows_ss = pushed(rows_ss, ss)
        done = row - RADIUS
        if done >= top:
            one, other, trust = pixels(first, second, weight, done, column, width, WEIGHTED)
            difference, total = one - other, one + other - 1.0
            slope = by_means + 2.0 * (difference * by_dd + total * by_ss)
            if not IS_MAP:
                sign = (difference > 0.0).to(tl.float32) - (difference < 0.0).to(tl.float32)
                slope = tl.load(upstream) * scale * (trust * sign - ssim_weight * slope)
                if WEIGHTED:
                    slope = tl.where(trust > 0.0, slope, 0.0)
            place = gradient + done.to(tl.int64) * length + column
            tl.store(place, slope, mask=column < length)
