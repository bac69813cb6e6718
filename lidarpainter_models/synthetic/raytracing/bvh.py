"""Bounding volume hierarchy over primitives, built by the binned surface area heuristic.

Wald, "On fast construction of SAH-based bounding volume hierarchies" (2007). Each node holds the
boxes of both children, so a ray reads one row per step.
"""

import numba
import numpy as np

NUM_BINS = 16
MAX_LEAF = 4


@numba.njit(cache=True, error_model="numpy")
def _area(lower: np.ndarray, upper: np.ndarray) -> float:
    x, y, z = upper[0] - lower[0], upper[1] - lower[1], upper[2] - lower[2]
    return x * y + y * z + z * x


@numba.njit(cache=True, error_model="numpy")
def _bounds_of(
    lower: np.ndarray, upper: np.ndarray, order: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    low = np.full(3, np.float32(np.inf), np.float32)
    high = np.full(3, np.float32(-np.inf), np.float32)
    for item in order:
        for axis in range(3):
            low[axis] = min(low[axis], lower[item, axis])
            high[axis] = max(high[axis], upper[item, axis])
    return low, high


@numba.njit(cache=True, error_model="numpy")
def _bin_costs(
    lower: np.ndarray, upper: np.ndarray, order: np.ndarray, bins: np.ndarray
) -> np.ndarray:
    """Cost of splitting after each bin."""
    low = np.full((NUM_BINS, 3), np.float32(np.inf), np.float32)
    high = np.full((NUM_BINS, 3), np.float32(-np.inf), np.float32)
    count = np.zeros(NUM_BINS, np.int64)
    for position in range(order.size):
        item, slot = order[position], bins[position]
        count[slot] += 1
        for axis in range(3):
            low[slot, axis] = min(low[slot, axis], lower[item, axis])
            high[slot, axis] = max(high[slot, axis], upper[item, axis])
    costs = np.zeros(NUM_BINS - 1)
    for direction in range(2):
        box_low = np.full(3, np.float32(np.inf), np.float32)
        box_high = np.full(3, np.float32(-np.inf), np.float32)
        total = 0
        for step in range(NUM_BINS - 1):
            slot = step if direction == 0 else NUM_BINS - 1 - step
            box_low = np.minimum(box_low, low[slot])
            box_high = np.maximum(box_high, high[slot])
            total += count[slot]
            split = slot if direction == 0 else slot - 1
            costs[split] += total * _area(box_low, box_high) if total else np.inf
    return costs


@numba.njit(cache=True, error_model="numpy")
def _bins(centres: np.ndarray, low: float, high: float) -> np.ndarray:
    """Bin of every centre along one axis."""
    scale = NUM_BINS / (high - low)
    return np.minimum(((centres - low) * scale).astype(np.int64), NUM_BINS - 1)


@numba.njit(cache=True, error_model="numpy")
def _partition(lower: np.ndarray, upper: np.ndarray, order: np.ndarray) -> int:
    """Reorder `order` in place; gives the size of its first part."""
    centres = np.empty((order.size, 3), np.float32)
    for position in range(order.size):
        centres[position] = lower[order[position]] + upper[order[position]]
    low, high = np.empty(3, np.float32), np.empty(3, np.float32)
    for axis in range(3):
        low[axis], high[axis] = centres[:, axis].min(), centres[:, axis].max()
    if (high - low).max() < 1e-6:
        return order.size // 2
    best_cost, best_axis, split = np.inf, 0, 0
    for axis in range(3):
        if high[axis] - low[axis] < 1e-6:
            continue
        costs = _bin_costs(lower, upper, order, _bins(centres[:, axis], low[axis], high[axis]))
        place = int(np.argmin(costs))
        if costs[place] < best_cost:
            best_cost, best_axis, split = costs[place], axis, place
    bins = _bins(centres[:, best_axis], low[best_axis], high[best_axis])
    first = order[bins <= split]
    second = order[bins > split]
    order[: first.size] = first
    order[first.size :] = second
    return first.size


@numba.njit(cache=True, error_model="numpy")
def build_tree(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tree over boxes (float32 (items, 3) each); node 0 is the root.

    Returns:
        node_bounds and node_children as in `SceneArrays` (leaves count items of the returned
        order), and the order, int64 (items).
    """
    num_items = lower.shape[0]
    order = np.arange(num_items)
    bounds = np.zeros((max(num_items, 1), 12), np.float32)
    children = np.full((max(num_items, 1), 2), -1, np.int32)  # -1 is a leaf of nothing
    bounds[:, 0:3], bounds[:, 3:6] = np.float32(1e30), np.float32(-1e30)
    bounds[:, 6:9], bounds[:, 9:12] = np.float32(1e30), np.float32(-1e30)
    stack = np.empty((128, 3), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, 0, num_items
    top, num_nodes = 1, 1
    while top > 0:
        top -= 1
        node, start, end = stack[top]
        middle = start + _partition(lower, upper, order[start:end]) if end - start > 1 else end
        for side in range(2):
            first, last = (start, middle) if side == 0 else (middle, end)
            if first == last:
                continue
            low, high = _bounds_of(lower, upper, order[first:last])
            bounds[node, side * 6 : side * 6 + 3] = low
            bounds[node, side * 6 + 3 : side * 6 + 6] = high
            if last - first <= MAX_LEAF:
                children[node, side] = -(first * 8 + last - first) - 1
            else:
                children[node, side] = num_nodes
                stack[top, 0], stack[top, 1], stack[top, 2] = num_nodes, first, last
                num_nodes += 1
                top += 1
    return bounds[:num_nodes].copy(), children[:num_nodes].copy(), order
