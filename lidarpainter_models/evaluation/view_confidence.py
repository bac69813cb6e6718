"""How good a frame is likely to be, from what was measured of it without its true image.

    predicted PSNR = intercept + sum of weight * evidence          (all weights >= 0)
    confidence     = 1 / (1 + exp(-(predicted - 25 dB - offset) / spread))

The confidence is the probability that the frame has 25 dB or more against its true image, at the
size of the fit. The weights are those of a least-squares fit on synthetic streets, whose true
images are known from anywhere; offset and spread those of a logistic regression on streets that
the weights did not see (Platt scaling). `scripts/calibrate_confidence.py` makes both.

Logs part from streets, so a run anchors the numbers on held-out frames of its own log. Its shift
has the prior N(0, `LOGS_PART_DB`^2); with n frames whose residuals (measured - predicted) have mean
m and deviation s, all in dB,

    kept = n LOGS_PART_DB^2 / (n LOGS_PART_DB^2 + s^2),    shift = kept m,
    deviation^2 = s^2 + (1 - kept) LOGS_PART_DB^2,         spread = deviation sqrt(3) / pi.

A log that is worse lowers every prediction. One that is better raises those alone that are as high
as its held-out frames were on average, since what is shown well on the path need not be beside it.
Without such frames nothing moves and the whole deviation between logs is left.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean, stdev

from lidarpainter_models.conditioning.view_evidence import ViewEvidence

GOOD_DB = 25.0
"""A frame as good as this against its true image can be trusted."""
PROMISED = 0.9
"""A frame is said to be good from this confidence on."""
LOGS_PART_DB = 2.0
"""Deviation between logs of what is measured from what is predicted, on average over a log: streets
and the few real logs that were measured part by 1 to 1.5 dB, and few are no promise for all."""
LEAST_FRAMES = 3
"""Fewer held-out frames say nothing about a log."""
RISE_DB = 1.0
"""So far below the mean of the held-out frames a raise has faded to nothing."""
DEVIATIONS = math.pi / math.sqrt(3)
"""Deviation of a logistic distribution of spread 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameConfidence:
    """What is said about a frame."""

    predicted_db: float
    confidence: float
    """Probability of `GOOD_DB` or better."""

    @property
    def is_promised(self) -> bool:
        """Whether the frame is said to be good."""
        return self.confidence >= PROMISED


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Numbers that turn evidence into a confidence, and how they came about."""

    intercept_db: float
    weights: Mapping[str, float]
    """By the names of `ViewEvidence`; none is negative, so more evidence never lowers it."""
    offset_db: float
    spread_db: float
    record: str
    raised_db: float = 0.0
    """Added to predictions of `raised_from_db` or more; never negative."""
    raised_from_db: float = 0.0

    def of(self, evidence: ViewEvidence) -> FrameConfidence:
        """What is said about the frame that the evidence was measured for."""
        found = (weight * getattr(evidence, name) for name, weight in self.weights.items())
        predicted_db = self.intercept_db + sum(found)
        part = 1 + (predicted_db - self.raised_from_db) / RISE_DB
        predicted_db += self.raised_db * min(max(part, 0.0), 1.0)
        beyond = (predicted_db - GOOD_DB - self.offset_db) / self.spread_db
        return FrameConfidence(predicted_db=predicted_db, confidence=_logistic(beyond))

    def anchored(self, held_out_db: Sequence[tuple[float, float]]) -> "Calibration":
        """For one log, by the predicted and the measured PSNR of its held-out frames.

        The weights stay, so more evidence still never lowers a confidence. Fewer frames than
        `LEAST_FRAMES` count as none: then no log is promised more than before.
        """
        if len(held_out_db) < LEAST_FRAMES:
            kept, mean_db, above_db, scatter_db = 0.0, 0.0, 0.0, self.spread_db * DEVIATIONS
            checked = "not checked against held-out frames of this log"
        else:
            residuals = [measured - predicted for predicted, measured in held_out_db]
            mean_db, above_db = fmean(residuals), fmean(predicted for predicted, _ in held_out_db)
            scatter_db = max(self.spread_db * DEVIATIONS, stdev(residuals))
            known = len(residuals) * LOGS_PART_DB**2
            kept = known / (known + scatter_db**2)
            checked = f"anchored on {len(residuals)} held-out frames of this log"
        deviation_db = math.hypot(scatter_db, LOGS_PART_DB * math.sqrt(1 - kept))
        return replace(
            self,
            intercept_db=self.intercept_db + min(kept * mean_db, 0.0),
            raised_db=max(kept * mean_db, 0.0),
            raised_from_db=above_db,
            spread_db=deviation_db / DEVIATIONS,
            record=f"{self.record}; {checked}",
        )


BUNDLED = Calibration(
    intercept_db=-7.91,
    weights={"recorded_db": 0.213, "expected_db": 0.491, "support": 18.88},
    offset_db=-0.149,
    spread_db=0.832,
    record="1020 frames of the synthetic streets 101 to 107 and 201 to 205, 2026-11-23",
)
"""Streets of one front camera, 160 to 320 pixels wide, 8 to 64 beams, first and last fits of
preset `brief` with all and with a quarter of its first steps, as they are: unpainted."""


def _logistic(value: float) -> float:
    return 1 / (1 + math.exp(-value)) if value > -700 else 0.0
