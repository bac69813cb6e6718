"""Triton kernels of the sky texture; `triton.py` launches them. One lane a pixel or a texel.

Pixel gradients are summed on texels as integers, whose sum does not depend on the order in which
atomics come: every texel's largest term is found first, and says how fine its integers are.
"""

import math

import triton
import triton.language as tl

HALF_PI = tl.constexpr(math.pi / 2)
PI = tl.constexpr(math.pi)
TURN = tl.constexpr(2 * math.pi)
BLOCK = tl.constexpr(1024)
"""Lanes of a program."""
VALUES = tl.constexpr(4)
"""Summed on a texel: three colours' gradients and the weight."""
NOT_FINITE = tl.constexpr(255)
"""Exponent of infinity and of NaN in the bits of a float32."""
LOG_BETA_1 = tl.constexpr(math.log(0.9))
LOG_BETA_2 = tl.constexpr(math.log(0.99))
MOST_VISITS = tl.constexpr(1000)
"""Visits of a texel that are counted: afterwards Adam's biases are gone."""


@triton.jit
def _lanes():
    return tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)


@triton.jit
def _atan2(y, x):
    """Arc tangent by the odd polynomial of degree 11 on [0, 1], as numba's; error under 2e-6."""
    smaller, larger = tl.minimum(tl.abs(y), tl.abs(x)), tl.maximum(tl.abs(y), tl.abs(x))
    a = smaller / tl.maximum(larger, 1e-20)
    s = a * a
    r = -0.01172120 * s + 0.05265332
    r = r * s - 0.11643287
    r = r * s + 0.19354346
    r = r * s - 0.33262347
    r = (r * s + 0.99997726) * a
    r = tl.where(tl.abs(y) > tl.abs(x), HALF_PI - r, r)
    r = tl.where(x < 0, PI - r, r)
    return tl.where(y < 0, -r, r)


@triton.jit(do_not_specialize=["width", "count"])
def locate_pixels(
    places,
    width,
    count,
    fx,
    fy,
    cx,
    cy,
    r00,
    r01,
    r02,
    r10,
    r11,
    r12,
    r20,
    r21,
    r22,
    left,
    top,
    texel,
    margin,
):
    """Continuous (column, row) of pixels' rays; r are the rows of the camera's rotation."""
    pixel = _lanes()
    x = ((pixel % width).to(tl.float32) + 0.5 - cx) / fx
    y = ((pixel // width).to(tl.float32) + 0.5 - cy) / fy
    dx = r00 * x + r01 * y + r02
    dy = r10 * x + r11 * y + r12
    dz = r20 * x + r21 * y + r22
    turn = left - _atan2(dy, dx)
    # into [-margin, turn - margin): directions outside a crop go to its nearer edge
    turn = tl.where(turn < -margin, turn + TURN, turn)
    turn = tl.where(turn >= TURN - margin, turn - TURN, turn)
    drop = top - _atan2(dz, tl.sqrt_rn(dx * dx + dy * dy))
    tl.store(places + 2 * pixel, turn / texel, mask=pixel < count)
    tl.store(places + 2 * pixel + 1, drop / texel, mask=pixel < count)


@triton.jit
def _corners(places, pixel, mask, columns, rows, WRAPS: tl.constexpr):
    """The four texels around pixels' places, and the share that each has of the pixel."""
    column = tl.load(places + 2 * pixel, mask=mask, other=0.0) - 0.5
    row = tl.load(places + 2 * pixel + 1, mask=mask, other=0.0) - 0.5
    row = tl.minimum(tl.maximum(row, 0.0), rows - 1.0)
    if not WRAPS:
        column = tl.minimum(tl.maximum(column, 0.0), columns - 1.0)
    left, upper = tl.floor(column), tl.floor(row)
    wc, wr = column - left, row - upper
    c0, r0 = left.to(tl.int64), upper.to(tl.int64)
    if WRAPS:  # a remainder has the sign of what is divided
        c0 = (c0 % columns + columns) % columns
        c1 = (c0 + 1) % columns
    else:
        c1 = tl.minimum(c0 + 1, columns - 1)
    above, below = r0 * columns, tl.minimum(r0 + 1, rows - 1) * columns
    texels = (above + c0, above + c1, below + c0, below + c1)
    shares = ((1.0 - wr) * (1.0 - wc), (1.0 - wr) * wc, wr * (1.0 - wc), wr * wc)
    return texels, shares


@triton.jit(do_not_specialize=["columns", "rows", "count"])
def sample_pixels(texture, places, wanted, rgb, columns, rows, count, WRAPS: tl.constexpr):
    """Bilinear colours at the places of the wanted pixels, black elsewhere."""
    pixel = _lanes()
    sees = tl.load(wanted + pixel, mask=pixel < count, other=0) != 0
    texels, shares = _corners(places, pixel, sees, columns, rows, WRAPS)
    for channel in tl.static_range(3):
        colour = tl.zeros([BLOCK], tl.float32)
        for corner in tl.static_range(4):
            seen = tl.load(texture + 3 * texels[corner] + channel, mask=sees, other=0.0)
            colour += shares[corner] * seen
        tl.store(rgb + 3 * pixel + channel, colour, mask=pixel < count)


@triton.jit
def _value(gradient, weight, pixel, mask, CHANNEL: tl.constexpr):
    """What pixels hand on: the gradient of a colour, or their weight."""
    if CHANNEL == 3:
        value = tl.load(weight + pixel, mask=mask, other=0.0)
    else:
        value = tl.load(gradient + 3 * pixel + CHANNEL, mask=mask, other=0.0)
    return value


@triton.jit(do_not_specialize=["columns", "rows", "count"])
def find_peaks(gradient, weight, places, peaks, columns, rows, count, WRAPS: tl.constexpr):
    """Bits of the largest term of each texel's sums; they are ordered as the numbers are."""
    pixel = _lanes()
    mask = tl.load(weight + pixel, mask=pixel < count, other=0.0) > 0
    texels, shares = _corners(places, pixel, mask, columns, rows, WRAPS)
    for channel in tl.static_range(VALUES):
        value = _value(gradient, weight, pixel, mask, channel)
        for corner in tl.static_range(4):
            bits = tl.abs(shares[corner] * value).to(tl.int32, bitcast=True)
            tl.atomic_max(peaks + VALUES * texels[corner] + channel, bits, mask=mask)


@triton.jit
def _power_of_two(exponent):
    """Two to the power of a whole exponent, as float64."""
    return ((exponent + 1023).to(tl.int64) << 52).to(tl.float64, bitcast=True)


@triton.jit
def _exponent(peak):
    """Exponent of a float32 from its bits; numbers below the normal ones have the least."""
    return tl.maximum(peak >> 23, 1) - 127


@triton.jit(do_not_specialize=["columns", "rows", "count", "digits"])
def add_terms(
    gradient, weight, places, peaks, sums, columns, rows, count, digits, WRAPS: tl.constexpr
):
    """Add up each texel's terms as integers, its largest term having so many binary digits."""
    pixel = _lanes()
    mask = tl.load(weight + pixel, mask=pixel < count, other=0.0) > 0
    texels, shares = _corners(places, pixel, mask, columns, rows, WRAPS)
    for channel in tl.static_range(VALUES):
        value = _value(gradient, weight, pixel, mask, channel)
        for corner in tl.static_range(4):
            place = VALUES * texels[corner] + channel
            peak = tl.load(peaks + place, mask=mask, other=0)
            sound = mask & ((peak >> 23) < NOT_FINITE)
            term = (shares[corner] * value).to(tl.float64)
            term *= _power_of_two(digits - 1 - _exponent(peak))
            tl.atomic_add(sums + place, tl.where(sound, term, 0.0).to(tl.int64), mask=sound)


@triton.jit(do_not_specialize=["count", "digits"])
def finish_sums(peaks, sums, texel_gradient, texel_weight, count, digits):
    """Sums as float32."""
    texel = _lanes()
    mask = texel < count
    for channel in tl.static_range(VALUES):
        peak = tl.load(peaks + VALUES * texel + channel, mask=mask, other=0)
        whole = tl.load(sums + VALUES * texel + channel, mask=mask, other=0)
        total = whole.to(tl.float64) * _power_of_two(_exponent(peak) + 1 - digits)
        total = tl.where((peak >> 23) < NOT_FINITE, total.to(tl.float32), float("nan"))
        if channel == 3:
            tl.store(texel_weight + texel, total, mask=mask)
        else:
            tl.store(texel_gradient + 3 * texel + channel, total, mask=mask)


@triton.jit(do_not_specialize=["count"])
def step_adam(texture, first, second, visits, gradient, weight, rate, count):
    """One Adam step in place on every texel of positive weight, each with its own step count."""
    texel = _lanes()
    mask = tl.load(weight + texel, mask=texel < count, other=0.0) > 0
    visit = tl.load(visits + texel, mask=mask, other=0) + 1
    tl.store(visits + texel, visit, mask=mask)
    steps = tl.minimum(visit, MOST_VISITS).to(tl.float64)
    bias_1 = (1.0 - tl.exp(steps * LOG_BETA_1)).to(tl.float32)
    bias_2 = (1.0 - tl.exp(steps * LOG_BETA_2)).to(tl.float32)
    for channel in tl.static_range(3):
        place = 3 * texel + channel
        slope = tl.load(gradient + place, mask=mask, other=0.0)
        mean = 0.9 * tl.load(first + place, mask=mask, other=0.0) + 0.1 * slope
        square = 0.99 * tl.load(second + place, mask=mask, other=0.0) + 0.01 * slope * slope
        tl.store(first + place, mean, mask=mask)
        tl.store(second + place, square, mask=mask)
        spread = tl.sqrt_rn(tl.div_rn(square, bias_2)) + 1e-12
        step = rate * tl.div_rn(tl.div_rn(mean, bias_1), spread)
        colour = tl.load(texture + place, mask=mask, other=0.0) - step
        colour = tl.maximum(colour, 0.0, propagate_nan=tl.PropagateNan.ALL)
        colour = tl.minimum(colour, 1.0, propagate_nan=tl.PropagateNan.ALL)
        tl.store(texture + place, colour, mask=mask)
