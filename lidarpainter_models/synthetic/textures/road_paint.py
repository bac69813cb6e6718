"""Lines, crossings, words and arrows painted on the road."""

import numpy as np

from lidarpainter_models.synthetic.plan.layout import LANE_M, StreetPlan
from lidarpainter_models.synthetic.textures.ground import (
    GREEN,
    WHITE,
    YELLOW,
    GroundCanvas,
    lay_asphalt,
    lay_ironwork,
    lay_repairs,
    parking_edge,
    stencil,
    strip,
)
from lidarpainter_models.synthetic.textures.noise import as_rgba, coarse_noise

DASH_M = 3.0
GAP_M = 6.0
LINE_M = 0.13


def paint_road(
    plan: StreetPlan, rng: np.random.Generator, start_m: float, end_m: float, per_m: float
) -> np.ndarray:
    """RGBA image of the road from kerb to kerb over a stretch."""
    canvas = GroundCanvas.blank(start_m, end_m, plan.left_kerb_m, plan.right_kerb_m, per_m)
    lay_asphalt(canvas, rng, plan)
    lay_repairs(canvas, rng, plan)
    wear = _wear(canvas, rng)
    for first, last in _stretches(plan, start_m, end_m):
        _paint_lines(canvas, plan, first, last, wear)
    _paint_crossing(canvas, plan, wear)
    _paint_words(canvas, plan)
    lay_ironwork(canvas, rng, plan)
    scratched = 1.0 - 0.25 * (1.0 - wear)
    canvas.colour *= np.where(canvas.paint[..., None] > 0.3, scratched[..., None], 1.0)
    return as_rgba(canvas.colour, canvas.paint)


def _wear(canvas: GroundCanvas, rng: np.random.Generator) -> np.ndarray:
    """How much paint is left, 0..1."""
    rows, columns = canvas.paint.shape
    cells = max(int(rows / canvas.per_m * 3), 1), max(int(columns / canvas.per_m * 3), 1)
    noise = coarse_noise(rng, (rows, columns), cells, persistence=0.75)
    return np.clip((noise - 0.27) * 6.0, 0.12, 1.0)


def _stretches(plan: StreetPlan, start_m: float, end_m: float) -> list[tuple[float, float]]:
    """Where lines run: not over the crossing of the two streets."""
    before = start_m, min(plan.cross_start_m - 4.6, end_m)
    after = max(plan.cross_end_m + 4.6, start_m), end_m
    return [stretch for stretch in (before, after) if stretch[1] > stretch[0]]


def _dashes(first: float, last: float) -> list[tuple[float, float]]:
    """Dashes at fixed places of the street, so that neighbouring images agree."""
    period = DASH_M + GAP_M
    starts = np.arange(np.floor(first / period) * period, last, period)
    pairs = [(max(start, first), min(start + DASH_M, last)) for start in starts]
    return [pair for pair in pairs if pair[1] - pair[0] > 0.1]


def _paint_lines(
    canvas: GroundCanvas, plan: StreetPlan, first: float, last: float, wear: np.ndarray
) -> None:
    """All lines along a stretch."""
    for side in (-0.11, 0.11):
        line = strip(first, last, plan.centre_d_m + side, 0.1)
        canvas.fill(line, YELLOW, is_paint=True, wear=wear)
    _paint_dashes(canvas, plan, first, last, wear)
    right_edge, left_edge = parking_edge(plan)
    if plan.right_side == "bike":
        middle = (right_edge - LANE_M / 2) / 2
        lane = strip(first, last, middle, plan.right_extra_m - 0.3)
        canvas.fill(lane, GREEN, strength=0.5, wear=wear)
    for d in (-LANE_M / 2, right_edge, left_edge):
        canvas.fill(strip(first, last, d, LINE_M), WHITE, is_paint=True, wear=wear)
    for s in np.arange(np.ceil(first / 6.0) * 6.0, last, 6.0):  # ticks between parking places
        for edge, kerb in ((right_edge, plan.right_kerb_m), (left_edge, plan.left_kerb_m)):
            middle = edge + np.sign(kerb) * 0.45
            tick = strip(s - 0.05, s + 0.05, middle, 0.9)
            canvas.fill(tick, WHITE, is_paint=True, wear=wear)


def _paint_dashes(
    canvas: GroundCanvas, plan: StreetPlan, first: float, last: float, wear: np.ndarray
) -> None:
    """Broken lines between lanes of one direction, and beside a turning lane."""
    is_turn = plan.left_side == "turn"
    for start, end in _dashes(first, last):
        dash = strip(start, end, LANE_M / 2, LINE_M)
        canvas.fill(dash, YELLOW if is_turn else WHITE, is_paint=True, wear=wear)
        for lane in plan.oncoming_d_m[:-1]:
            dash = strip(start, end, lane + LANE_M / 2, LINE_M)
            canvas.fill(dash, WHITE, is_paint=True, wear=wear)
    if is_turn:
        canvas.fill(strip(first, last, LANE_M / 2 - 0.22, 0.1), YELLOW, is_paint=True, wear=wear)


def _paint_crossing(canvas: GroundCanvas, plan: StreetPlan, wear: np.ndarray) -> None:
    """Two ladder crossings and a stop line before each."""
    for inner, outwards in ((plan.cross_start_m - 0.6, -1.0), (plan.cross_end_m + 0.6, 1.0)):
        near, far = sorted((inner, inner + outwards * 2.8))
        for d in np.arange(plan.right_kerb_m + 0.5, plan.left_kerb_m - 0.3, 1.2):
            canvas.fill(strip(near, far, d, 0.55), WHITE, is_paint=True, wear=wear)
        stop = inner + outwards * 3.9
        low, high = (plan.right_kerb_m + 2.3, plan.centre_d_m - 0.2)
        if outwards > 0:
            low, high = plan.centre_d_m + 0.2, plan.left_kerb_m - 2.3
        bar = strip(stop - 0.22, stop + 0.22, (low + high) / 2, high - low)
        canvas.fill(bar, WHITE, is_paint=True, wear=wear)


def _paint_words(canvas: GroundCanvas, plan: StreetPlan) -> None:
    """Words and arrows in the lanes, every few tens of metres."""
    right_edge, _ = parking_edge(plan)
    middle = (right_edge - LANE_M / 2) / 2
    words = ("BIKE", "LANE") if plan.right_side == "bike" else ("BUS", "ONLY")
    width = plan.right_extra_m * 0.66
    places = np.arange(canvas.start_m + 9.0, canvas.start_m + 400, 26.0)
    end_m = canvas.start_m + canvas.paint.shape[1] / canvas.per_m
    for s in places[places < end_m - 6]:
        if plan.cross_start_m - 10 < s < plan.cross_end_m + 6:
            continue
        stencil(canvas, words[0], (s, middle), (2.0, width))
        stencil(canvas, words[1], (s + 3.2, middle), (2.0, width))
    stop = plan.cross_start_m - 9.0
    _arrow(canvas, (stop, 0.0), turns_left=False)
    _arrow(canvas, (stop, LANE_M), turns_left=plan.left_side == "turn")
    stencil(canvas, "SLOW", (max(canvas.start_m + 30, 22.0), 0.0), (2.4, 1.9))


def _arrow(canvas: GroundCanvas, place: tuple[float, float], *, turns_left: bool) -> None:
    """An arrow ahead, or to the left."""
    s, d = place
    canvas.fill(strip(s - 1.6, s + 0.5, d, 0.18), WHITE, is_paint=True)
    head = np.array([[s + 0.4, d - 0.45], [s + 1.7, d], [s + 0.4, d + 0.45]])
    if turns_left:
        canvas.fill(strip(s + 0.35, s + 0.55, d + 0.4, 0.8), WHITE, is_paint=True)
        head = np.array([[s + 0.0, d + 0.7], [s + 0.45, d + 1.5], [s + 0.9, d + 0.7]])
    canvas.fill(head, WHITE, is_paint=True)
