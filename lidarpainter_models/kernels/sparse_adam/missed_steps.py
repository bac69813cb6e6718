"""What stands for the steps that a row missed, as tables for code that treats all rows at once.

A row that missed k steps moves by the sum over j = 1..k of

    rate_j BETA1^j / (1 - BETA1^t_j)  *  m / (sqrt(v) d_j + eps),
    d_j = sqrt(BETA2^j / (1 - BETA2^t_j)),  t_j the number of the j-th missed step.

The tables hold weights and depths d by how many steps were missed; see `cpu` for why a run of
steps can be replaced by two nodes with its moments 0 to 3.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lidarpainter_models.kernels.sparse_adam import BETA1, BETA2, MISSED_RUN_ENDS


class MissedSteps(NamedTuple):
    """Nodes in their order; a row takes part from the first on that it missed steps enough for."""

    weight: Float[np.ndarray, "nodes missed kinds"]
    depth: Float[np.ndarray, "nodes missed kinds"]
    least: list[int]
    """The number of missed steps from which on each node counts, ascending."""
    lead: Float[np.ndarray, "nodes missed"]
    """Part of a node's move after which the Gaussian has its mean size."""


def single_steps(rates: list[list[float]], now: int) -> MissedSteps:
    """Every missed step by itself; `rates` are those of the latest steps up to `now`."""
    share, depth = _steps(np.array(rates), now)
    count = len(rates)
    return MissedSteps(share, depth, [*range(1, count + 1)], np.zeros((count, count + 1)))


def gathered_steps(rates: list[list[float]], now: int) -> MissedSteps:
    """Runs of missed steps, each as two nodes; exact up to eight missed steps."""
    share, depth = _steps(np.array(rates), now)
    weights, depths, least, lead = [], [], [], []
    begin = 1
    for end in MISSED_RUN_ENDS:
        if begin > len(rates):
            break
        run = slice(begin - 1, min(end, len(rates)))
        pair = _two_nodes(share[run], depth[run])
        weights += [pair[0], pair[2]]
        depths += [pair[1], pair[3]]
        least += [begin, begin + 1]
        steps = np.clip(np.arange(len(rates) + 1) - begin + 1, 1, end - begin + 1)
        lead += [0.5 - np.minimum(steps, 2) / (2.0 * steps)] * 2
        begin = end + 1
    return MissedSteps(np.stack(weights), np.stack(depths), least, np.stack(lead))


def _steps(
    rates: Float[np.ndarray, "steps kinds"], now: int
) -> tuple[Float[np.ndarray, "steps missed kinds"], Float[np.ndarray, "steps missed kinds"]]:
    """Weight and depth of the j-th missed step by steps missed in all; no weight beyond them."""
    count = len(rates)
    j = np.arange(1, count + 1)[:, None]
    missed = np.arange(count + 1)[None]
    number = now - missed + j
    is_missed = j <= missed
    number = np.where(is_missed, number, now)
    rate = rates[np.where(is_missed, count - missed + j - 1, 0)]
    share = np.where(is_missed, BETA1**j / (1.0 - BETA1**number), 0.0)[..., None] * rate
    depth = np.sqrt(BETA2**j / (1.0 - BETA2**number))[..., None]
    return share, depth.repeat(rates.shape[1], axis=-1)


def _two_nodes(
    share: Float[np.ndarray, "steps missed kinds"], depth: Float[np.ndarray, "steps missed kinds"]
) -> tuple[Float[np.ndarray, "missed kinds"], ...]:
    """Weight and depth of two nodes (Gauss' rule for a discrete measure), the earlier one first."""
    total = share.sum(axis=0)
    safe = np.where(total > 0, total, 1.0)
    mean = (share * depth).sum(axis=0) / safe
    offset = depth - mean
    spread = (share * offset**2).sum(axis=0) / safe
    is_pair = (share > 0).sum(axis=0) > 1
    middle = 0.5 * (share * offset**3).sum(axis=0) / np.where(is_pair, spread * safe, 1.0)
    reach = np.sqrt(middle**2 + np.where(is_pair, spread, 1.0))
    near, far = middle + reach, middle - reach
    first = np.where(is_pair, -total * far / (near - far), total)
    second = np.where(is_pair, total * near / (near - far), 0.0)
    return first, np.where(is_pair, mean + near, mean), second, np.where(is_pair, mean + far, 1.0)
