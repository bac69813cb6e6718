"""How well a painter repairs pairs whose true image is known.

Figures stand per source of pairs and over all of them. PSNR, SSIM and feature distance are means
over pairs; damaged and undamaged PSNR, the share outside the hull and the confidence pool the
pixels. An error is the mean absolute rgb difference of a pixel. Pixels where the target is unknown
never count; for SSIM and features they show the target.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import reduce
from statistics import fmean, median
from typing import Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from lidarpainter_models.errors import DataError
from lidarpainter_models.kernels.ssim import ssim_map
from lidarpainter_models.metrics.images import psnr_from_error, squared_error
from lidarpainter_models.metrics.perceptual import ImageDistance
from lidarpainter_models.painter.baselines import UnpaintedPainter, WarpPainter
from lidarpainter_models.painter.examples import PaintingPair, PairSource
from lidarpainter_models.painter.filters import input_hull
from lidarpainter_models.painter.protocol import Painter, Painting, PaintingConditions

NUM_SAMPLES = 4


def painting_samples(
    painter: Painter, sources: Mapping[str, PairSource]
) -> Float[Tensor, "height width 3"]:
    """A row per pair: render, LiDAR, painted, true image; the pairs lie evenly over all sources.

    Raises:
        DataError: a pair is damaged.
    """
    known = [(source, index) for source in sources.values() for index in range(len(source))]
    count = min(NUM_SAMPLES, len(known))
    rows = []
    for rank in range(count):
        source, index = known[rank * len(known) // count]
        pair = source.read(index)
        seen, painted = pair.conditions, painter.paint(pair.conditions).rgb
        rows.append(torch.cat([seen.render_rgb, seen.lidar_rgb, painted, pair.target_rgb], dim=1))
    width_px = max(row.shape[1] for row in rows)
    return torch.cat([functional.pad(row, (0, 0, 0, width_px - row.shape[1])) for row in rows])


DAMAGED_ERROR = 0.1
"""A pixel is damaged where the error of the render is above this."""
WRONG_ERROR = 0.05
"""A painted pixel is wrong where its error is above this: what the confidence should foretell."""
CONFIDENCE_BINS = 1 << 16
"""Confidences that share a bin count as equal."""


@runtime_checkable
class ScoringPairs(Protocol):
    """Pairs that are read whole, one after the other."""

    def __len__(self) -> int:
        """Number of pairs."""
        ...

    def read(self, index: int) -> PaintingPair:
        """A pair."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageFigures:
    """How close one kind of image comes to the truth."""

    psnr: float
    ssim: float
    feature_distance: float | None
    """SqueezeNet 1.1; None without its weights."""
    damaged_psnr: float | None
    """None where no pixel was damaged."""
    undamaged_psnr: float | None
    outside_hull: float
    """Share of pixels further than 0.05 outside what any input shows within 9x9 pixels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaintingGains:
    """PSNR of the painted image over that of others; None where one of them has no pixels."""

    over_input: float
    over_warp_mean: float
    """Over the mean of the render and the valid warps, which needs no learning."""
    damaged: float | None
    """Over the input, in damaged pixels."""
    undamaged: float | None
    """The same in undamaged ones; negative where painting harms them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceScores:
    """A painter's figures on one source of pairs, beside those of two images it starts from."""

    num_pairs: int
    damaged_share: float
    """Share of the pixels that are damaged in the input."""
    input: ImageFigures
    """The render as it is."""
    warp_mean: ImageFigures
    """The mean of the render and the valid warps."""
    painted: ImageFigures
    confidence_auc: float | None
    """Chance that a right pixel has more confidence than a wrong one (area under the ROC curve,
    ties count half); None where all pixels are right, or all wrong."""
    cpu_ms_per_frame: float
    """Process CPU time of painting one pair, all threads together; the median."""
    kept_share: float
    """Of the pixels that the painter left unpainted; 0 for painters that paint everything."""
    gains_db: PaintingGains


@dataclass(frozen=True, slots=True, kw_only=True)
class PaintingScores:
    """A painter's figures on pairs it never saw."""

    painter: str
    sources: dict[str, SourceScores]
    total: SourceScores
    """Over the pairs of all sources."""


def score_painter(
    painter: Painter,
    sources: Mapping[str, ScoringPairs],
    *,
    feature_distance: ImageDistance | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> PaintingScores:
    """Paint every pair and compare with the truth.

    Raises:
        DataError: a source without a pair whose target is known anywhere, or a damaged pair.
    """
    num_pairs, done = sum(len(source) for source in sources.values()), 0
    tallies: dict[str, _SourceTally] = {}
    for name, source in sources.items():
        tally = tallies[name] = _SourceTally()
        for index in range(len(source)):
            _score_pair(painter, source.read(index), tally, feature_distance)
            done += 1
            if progress is not None:
                progress(done, num_pairs)
        if not tally.num_known:
            raise DataError(f"pairs {name!r}: none has a known target, so nothing can be judged")
    if not tallies:
        raise DataError("no pairs to judge a painter on")
    return PaintingScores(
        painter=painter.name,
        sources={name: tally.scores() for name, tally in tallies.items()},
        total=reduce(_joined, tallies.values()).scores(),
    )


def outside_hull(
    image: Float[Tensor, "height width 3"], conditions: PaintingConditions
) -> Bool[Tensor, "height width"]:
    """Pixels with a channel beyond what the inputs show nearby, by more than a margin.

    Nearby is a square of 9 pixels; inputs are the render, LiDAR hits and valid warps.
    """
    hull = input_hull(conditions)
    return ((image > hull.upper) | (image < hull.lower)).any(dim=-1)


def confidence_auc(
    num_right: Float[Tensor, " bins"], num_wrong: Float[Tensor, " bins"]
) -> float | None:
    """Area under the ROC curve from counts of right and wrong pixels by rising confidence."""
    total = float(num_right.sum() * num_wrong.sum())
    if total == 0:
        return None
    num_right_above = num_right.sum() - num_right.cumsum(0)
    return float((num_wrong * (num_right_above + 0.5 * num_right)).sum()) / total


@dataclass
class _ImageTally:
    """Sums for the figures of one kind of image."""

    psnr: list[float] = field(default_factory=list)
    ssim: list[float] = field(default_factory=list)
    feature_distance: list[float] = field(default_factory=list)
    damaged_error: float = 0.0
    undamaged_error: float = 0.0
    num_outside: int = 0

    def add(
        self,
        image: Float[Tensor, "height width 3"],
        pair: PaintingPair,
        damaged: Bool[Tensor, "height width"],
        feature_distance: ImageDistance | None,
    ) -> None:
        known, truth = pair.target_valid, pair.target_rgb
        image = torch.where(known[..., None], image.clamp(0, 1), truth).contiguous()
        error = squared_error(image, truth).double()
        self.psnr.append(psnr_from_error(float(error[known].mean())))
        self.ssim.append(float(ssim_map(image, truth.contiguous()).mean(dim=-1)[known].mean()))
        self.damaged_error += float(error[known & damaged].sum())
        self.undamaged_error += float(error[known & ~damaged].sum())
        self.num_outside += int((outside_hull(image, pair.conditions) & known).sum())
        if feature_distance is not None:
            self.feature_distance.append(float(feature_distance(image, truth)))

    def figures(self, num_known: int, num_damaged: int) -> ImageFigures:
        return ImageFigures(
            psnr=fmean(self.psnr),
            ssim=fmean(self.ssim),
            feature_distance=fmean(self.feature_distance) if self.feature_distance else None,
            damaged_psnr=_pooled_psnr(self.damaged_error, num_damaged),
            undamaged_psnr=_pooled_psnr(self.undamaged_error, num_known - num_damaged),
            outside_hull=self.num_outside / num_known,
        )


def _no_counts() -> Float[Tensor, " bins"]:
    return torch.zeros(CONFIDENCE_BINS, dtype=torch.float64)


@dataclass
class _SourceTally:
    """Everything counted over the pairs of one source."""

    input: _ImageTally = field(default_factory=_ImageTally)
    warp_mean: _ImageTally = field(default_factory=_ImageTally)
    painted: _ImageTally = field(default_factory=_ImageTally)
    num_known: int = 0
    num_damaged: int = 0
    num_right: Tensor = field(default_factory=_no_counts)
    num_wrong: Tensor = field(default_factory=_no_counts)
    cpu_s: list[float] = field(default_factory=list)
    kept_shares: list[float] = field(default_factory=list)

    def add_confidence(self, painting: Painting, pair: PaintingPair) -> None:
        known = pair.target_valid
        bins = (painting.confidence.clamp(0, 1) * (CONFIDENCE_BINS - 1)).round().long()[known]
        wrong = _absolute_error(painting.rgb, pair.target_rgb)[known] > WRONG_ERROR
        self.num_right += torch.bincount(bins[~wrong], minlength=CONFIDENCE_BINS)
        self.num_wrong += torch.bincount(bins[wrong], minlength=CONFIDENCE_BINS)

    def scores(self) -> SourceScores:
        counts = (self.num_known, self.num_damaged)
        before, mean = self.input.figures(*counts), self.warp_mean.figures(*counts)
        painted = self.painted.figures(*counts)
        return SourceScores(
            num_pairs=len(self.cpu_s),
            damaged_share=self.num_damaged / self.num_known,
            input=before,
            warp_mean=mean,
            painted=painted,
            confidence_auc=confidence_auc(self.num_right, self.num_wrong),
            cpu_ms_per_frame=1000 * median(self.cpu_s),
            kept_share=fmean(self.kept_shares),
            gains_db=PaintingGains(
                over_input=painted.psnr - before.psnr,
                over_warp_mean=painted.psnr - mean.psnr,
                damaged=_gain(painted.damaged_psnr, before.damaged_psnr),
                undamaged=_gain(painted.undamaged_psnr, before.undamaged_psnr),
            ),
        )


_Tally = TypeVar("_Tally", _ImageTally, _SourceTally)


def _score_pair(
    painter: Painter,
    pair: PaintingPair,
    tally: _SourceTally,
    feature_distance: ImageDistance | None,
) -> None:
    """Paint one pair and count it; one whose target is known nowhere does not count."""
    if not bool(pair.target_valid.any()):
        return
    conditions = pair.conditions
    started = time.process_time()
    painting = painter.paint(conditions)
    tally.cpu_s.append(time.process_time() - started)
    tally.kept_shares.append(painting.kept_share)
    damaged = _absolute_error(conditions.render_rgb, pair.target_rgb) > DAMAGED_ERROR
    tally.num_known += int(pair.target_valid.sum())
    tally.num_damaged += int((damaged & pair.target_valid).sum())
    tally.add_confidence(painting, pair)
    images = (
        (tally.input, UnpaintedPainter().paint(conditions).rgb),
        (tally.warp_mean, WarpPainter().paint(conditions).rgb),
        (tally.painted, painting.rgb),
    )
    for one, image in images:
        one.add(image, pair, damaged, feature_distance)


def _joined(first: _Tally, second: _Tally) -> _Tally:
    """Everything counted in either: sums, and lists one after the other."""
    found = {}
    for part in fields(first):
        one, other = getattr(first, part.name), getattr(second, part.name)
        is_tally = isinstance(one, _ImageTally)
        found[part.name] = _joined(one, other) if is_tally else one + other
    return replace(first, **found)


def _absolute_error(
    image: Float[Tensor, "height width 3"], truth: Float[Tensor, "height width 3"]
) -> Float[Tensor, "height width"]:
    return (image.clamp(0, 1) - truth).abs().mean(dim=-1)


def _gain(after: float | None, before: float | None) -> float | None:
    return None if after is None or before is None else after - before


def _pooled_psnr(error_sum: float, num_pixels: int) -> float | None:
    return psnr_from_error(error_sum / num_pixels) if num_pixels else None
