"""How a scene shows held-out frames of its own log, beside what is predicted of them.

A log may be unlike all that confidences were calibrated on: night, rain, another lens. Its own
held-out frames tell by how much, and the calibration is moved there (`Calibration.anchored`).
World: x forward, y left, z up; metres.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any

from lidarpainter_models.conditioning.view_evidence import (
    LEAST_ERROR,
    EvidenceGatherer,
    ViewEvidence,
)
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.score_tables import HELD_OUT
from lidarpainter_models.evaluation.view_confidence import BUNDLED, LEAST_FRAMES, Calibration
from lidarpainter_models.evaluation.view_scores import ScoredView
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.metrics.images import psnr_from_error, squared_error

MOST_VIEWS = 24
"""Held-out views that a calibration is anchored on, each camera's evenly over time."""
UNLIKE_DB = 3.0
"""Twice as far as the streets of the calibration part from what is predicted of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgedFrame:
    """A held-out frame: what speaks for it, and how good it truly is."""

    name: str
    """Camera and frame: `front/3`."""
    evidence: ViewEvidence
    psnr_db: float
    """Of the scene as it is, at the size of the fit, without what the recording car hides."""


def judged_frames(held_out: HeldOut, gatherer: EvidenceGatherer) -> Iterator[JudgedFrame]:
    """Every held-out view at its interpolated pose; none of which all shows the recording car."""
    scene = gatherer.scene

    def judged(view: ScoredView) -> JudgedFrame:
        camera_name = view.name.partition("/")[0]
        shown = scene.render(view.camera, view.timestamp_ns, camera_name=camera_name).rgb
        error = squared_error(shown, view.truth_rgb.to(shown))
        if view.hidden is not None:
            error = error[~view.hidden.to(error.device)]
        return JudgedFrame(
            name=view.name,
            evidence=gatherer.of(view.camera, view.timestamp_ns, camera_name),
            psnr_db=psnr_from_error(max(float(error.mean()), LEAST_ERROR)),
        )

    views = held_out.recorded_views(scene, "interpolated")
    showing = [view for view in views if view.hidden is None or not view.hidden.all()]
    return side_by_side(judged, showing, scene.device)


def predicted_and_measured(frames: Iterable[JudgedFrame]) -> list[tuple[float, float]]:
    """PSNR of each frame as predicted by `BUNDLED`, and as it is."""
    return [(BUNDLED.of(frame.evidence).predicted_db, frame.psnr_db) for frame in frames]


def what_frames_say(held_out_db: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """What an envelope says of the log behind it, as JSON types.

    Args:
        held_out_db: PSNR of held-out frames of the log, by `BUNDLED` and as measured.
    """
    residuals = [measured - predicted for predicted, measured in held_out_db]
    is_checked = len(residuals) >= LEAST_FRAMES
    mean_db = fmean(residuals) if is_checked else None
    return {
        "num_frames": len(residuals),
        "residual_db": mean_db,
        "deviation_db": stdev(residuals) if is_checked else None,
        "is_unlike": mean_db is not None and abs(mean_db) > UNLIKE_DB,
    }


def calibration_of(envelope: Mapping[str, Any] | None) -> Calibration:
    """The numbers behind an envelope; those of a log that nobody checked where it has none."""
    if envelope is None or HELD_OUT not in envelope:  # of an older version
        return BUNDLED.anchored(())
    return Calibration(**envelope["calibration"])
