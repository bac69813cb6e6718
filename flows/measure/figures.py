"""Costs and qualities of points by the names that charts and tables show them under."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from catalog.points import MetricName, Point
from lidarpainter_models.evaluation.fronts import Spread
from lidarpainter_models.evaluation.score_tables import DEPTH

LANES = ("left-2m", "right-2m", "left-3m", "right-3m")
"""The paper's shifts to the sides."""
QUALITIES: dict[str, tuple[MetricName, ...]] = {
    "recorded_psnr": (("recorded", "recorded", "psnr"),),
    "recorded_ssim": (("recorded", "recorded", "ssim"),),
    "recorded_lpips": (("recorded", "recorded", "lpips"),),
    "actors_psnr": (("recorded", "recorded", "actors_psnr"),),
    "aside_psnr": tuple(("truth", lane, "psnr") for lane in LANES),
    "aside_ssim": tuple(("truth", lane, "ssim") for lane in LANES),
    "aside_lpips": tuple(("truth", lane, "lpips") for lane in LANES),
    "aside_depth": tuple(("depth", lane, DEPTH) for lane in LANES),
}
"""The numbers that each is the mean of; where one is missing it is not known."""
LABELS = {
    "recorded_psnr": "PSNR of held-out views, dB",
    "recorded_ssim": "SSIM of held-out views",
    "recorded_lpips": "LPIPS of held-out views",
    "actors_psnr": "PSNR inside actor boxes, dB",
    "aside_psnr": "PSNR 2 and 3 m aside against truth, dB",
    "aside_ssim": "SSIM 2 and 3 m aside against truth",
    "aside_lpips": "LPIPS 2 and 3 m aside against truth",
    "aside_depth": "LiDAR met within 5 %, 2 and 3 m aside",
    "cpu_seconds": "CPU time to make the scene, s",
    "seconds": "wall time to make the scene, s",
    "peak_memory_bytes": "peak memory, bytes",
    "num_gaussians": "Gaussians",
    "scene_bytes": "stored scene, bytes",
}
COSTS = ("cpu_seconds", "seconds", "peak_memory_bytes", "num_gaussians", "scene_bytes")


def qualities(metrics: Mapping[MetricName, float]) -> dict[str, float]:
    """What is known of one point."""
    return {
        name: fmean(metrics[one] for one in parts)
        for name, parts in QUALITIES.items()
        if all(one in metrics for one in parts)
    }


def figures_of(point: Point) -> dict[str, float]:
    """Costs and qualities of one point."""
    return {**point.cost, **qualities(point.metrics)}


@dataclass(frozen=True, kw_only=True)
class Group:
    """The points of one configuration on one scene, over all seeds."""

    scene: str
    configuration: str
    figures: dict[str, Spread]
    trials: dict[int, dict[str, float]]
    """The figures of each seed."""


def groups_of(points: Sequence[Point]) -> list[Group]:
    """Points by scene and configuration, in the order in which these come."""
    found: dict[tuple[str, str], dict[int, dict[str, float]]] = {}
    for point in points:
        trials = found.setdefault((point.scene, point.configuration), {})
        trials[point.seed] = figures_of(point)
    return [
        Group(scene=scene, configuration=name, figures=_spreads(trials), trials=trials)
        for (scene, name), trials in found.items()
    ]


def _spreads(trials: Mapping[int, Mapping[str, float]]) -> dict[str, Spread]:
    names = set.intersection(*(set(figures) for figures in trials.values()))
    return {
        name: Spread.of([figures[name] for figures in trials.values()])
        for name in (*COSTS, *QUALITIES)
        if name in names
    }
