"""The fit of the numbers behind the confidence of frames, and how far off such a confidence is."""

import math
from collections.abc import Sequence
from dataclasses import fields

import numpy as np
from jaxtyping import Bool, Float

from lidarpainter_models.conditioning.view_evidence import ViewEvidence
from lidarpainter_models.evaluation.view_confidence import GOOD_DB, Calibration

NEAR_DB = 4.0
"""Frames so far from `GOOD_DB` count half in the fit of the weights: the border matters."""
NUM_BINS = 10
EVIDENCE = tuple(field.name for field in fields(ViewEvidence))
"""The parts of the evidence that count."""


def calibrated(
    evidence: Sequence[ViewEvidence],
    psnr_db: Sequence[float],
    streets: Sequence[str],
    *,
    names: Sequence[str],
    record: str,
) -> Calibration:
    """Fit the numbers to frames whose PSNR against the true image is known.

    No street is predicted by weights that saw it. The named parts of the evidence count; `record`
    says what the frames were.
    """
    measured = np.array([[getattr(one, name) for name in names] for one in evidence])
    truth, groups = np.asarray(psnr_db, float), np.asarray(streets)
    unseen = np.empty_like(truth)
    for street in np.unique(groups):
        own = groups == street
        intercept, weights = _least_squares(measured[~own], truth[~own])
        unseen[own] = intercept + measured[own] @ weights
    offset_db, spread_db = _platt(unseen - GOOD_DB, truth >= GOOD_DB)
    intercept, weights = _least_squares(measured, truth)
    return Calibration(
        intercept_db=float(intercept),
        weights=dict(zip(names, weights.tolist(), strict=True)),
        offset_db=offset_db,
        spread_db=spread_db,
        record=record,
    )


def expected_calibration_error(confidences: Sequence[float], is_good: Sequence[bool]) -> float:
    """Mean distance of confidence from the share of good frames, over bins of equal width.

    Guo et al., "On calibration of modern neural networks" (2017); each bin counts by its frames.
    """
    said, true = np.asarray(confidences, float), np.asarray(is_good, float)
    place = np.minimum((said * NUM_BINS).astype(int), NUM_BINS - 1)
    gaps = [abs(said[place == one].sum() - true[place == one].sum()) for one in range(NUM_BINS)]
    return float(sum(gaps) / len(said))


def _least_squares(
    measured: Float[np.ndarray, "frames parts"], psnr_db: Float[np.ndarray, " frames"]
) -> tuple[float, Float[np.ndarray, " parts"]]:
    """Intercept and weights, none of them negative."""
    from scipy.optimize import lsq_linear

    near = 1 / np.sqrt(1 + np.square((psnr_db - GOOD_DB) / NEAR_DB))
    ones = np.ones((len(measured), 1))
    low = np.array([-np.inf, *([0.0] * measured.shape[1])])
    design = np.concatenate([ones, measured], axis=1) * near[:, None]
    found = lsq_linear(design, psnr_db * near, bounds=(low, np.inf)).x
    return found[0], found[1:]


def _platt(
    beyond_db: Float[np.ndarray, " frames"], is_good: Bool[np.ndarray, " frames"]
) -> tuple[float, float]:
    """Offset and spread of the likeliest logistic curve."""
    from scipy.optimize import minimize

    def loss(values: Float[np.ndarray, "2"]) -> float:
        scaled = (beyond_db - values[0]) / math.exp(values[1])
        return float(np.logaddexp(0, np.where(is_good, -scaled, scaled)).sum())

    offset, log_spread = minimize(loss, np.zeros(2), method="Nelder-Mead").x
    return float(offset), math.exp(log_spread)
