"""Costs and qualities of points by the names that charts and tables show them under."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Literal

from catalog.points import MetricName, Point
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.fronts import Spread
from lidarpainter_models.evaluation.score_tables import DEPTH, LIDAR, MARKINGS

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
    "lidar_within": ((LIDAR, "own", "within_10_cm"),),
    "lidar_drop": ((LIDAR, "neurad-studio", "ray_drop_accuracy"),),
    "markings_auc": tuple((MARKINGS, lane, "auc") for lane in LANES),
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
    "lidar_within": "simulated ranges within 10 cm of held-out sweeps",
    "lidar_drop": "rays told right to come back or not",
    "markings_auc": "painted lines told from road (AUC), 2 and 3 m aside",
    "cpu_seconds": "CPU time to make the scene, s",
    "seconds": "wall time to make the scene, s",
    "peak_memory_bytes": "peak memory, bytes",
    "num_gaussians": "Gaussians",
    "scene_bytes": "stored scene, bytes",
}
AT_END: Literal["final"] = "final"
"""The variant, painted or not, that is of the scene at the end."""
COSTS = ("cpu_seconds", "seconds", "peak_memory_bytes", "num_gaussians", "scene_bytes")

DERIVED: dict[str, tuple[str, float]] = {
    "cpu_minutes": ("cpu_seconds", 60.0),
    "memory_gb": ("peak_memory_bytes", 1e9),
}
"""What a cost is called in other units, and how many of its own units one of these is."""
SHARE = ".3f"
FORMATS = {
    "psnr": ".2f",
    "ssim": SHARE,
    "depth": SHARE,
    "depth_within_5_percent": SHARE,
    "lpips": SHARE,
    "auc": SHARE,
    "feature_distance": ".2f",
    "cpu_seconds": ".0f",
    "seconds": ".0f",
    "num_gaussians": ",.0f",
    "cpu_minutes": ".1f",
    "memory_gb": ".1f",
}
"""How figures are written, by their name or what it ends with behind / or _."""


def metric_names(figure: str) -> tuple[MetricName, ...]:
    """The numbers that a figure is the mean of; a cost is none.

    A figure is one of `QUALITIES`, or `protocol/trajectory/name` as the catalog has it, where
    several trajectories may stand with + between: `truth/left-2m+right-2m/psnr`.

    Raises:
        ConfigError: it is neither that nor one of `COSTS`.
    """
    if figure in COSTS:
        return ()
    if figure in QUALITIES:
        return QUALITIES[figure]
    protocol, *rest = figure.split("/")
    if len(rest) != 2 or not all((protocol, *rest)):
        raise ConfigError(
            f"no figure {figure!r}, expected protocol/trajectory/name or one of "
            f"{', '.join((*COSTS, *QUALITIES))}"
        )
    return tuple((protocol, trajectory, rest[1]) for trajectory in rest[0].split("+"))


def figure_of(point: Point, figure: str, variant: str) -> float | None:
    """A figure of one variant of a point, `final` being what it has at its end; None: not known."""
    if figure in COSTS:
        return point.cost[figure]
    known = point.metrics if variant == AT_END else point.by_variant.get(variant, {})
    names = metric_names(figure)
    return fmean(known[one] for one in names) if all(one in known for one in names) else None


def check_figure(figure: str) -> None:
    """Refuse what is no figure of a point, or cannot be written.

    Raises:
        ConfigError: it is none.
    """
    metric_names(measured_as(figure))
    if _format(figure) is None:
        raise ConfigError(f"how figure {figure!r} is written is not known")


def measured_as(figure: str) -> str:
    """The cost that a figure in other units is derived of, or the figure itself."""
    return DERIVED.get(figure, (figure, 1.0))[0]


def written(figure: str, value: float) -> str:
    """A figure as tables show it, from a value in the unit that it is measured in."""
    form = _format(figure) or ""
    text = f"{value / DERIVED.get(figure, (figure, 1.0))[1]:{form}}"
    return text.removeprefix("0") if form == SHARE else text


def _format(figure: str) -> str | None:
    last = figure.rpartition("/")[2]
    return FORMATS.get(last) or FORMATS.get(last.rpartition("_")[2])


def qualities(metrics: Mapping[MetricName, float]) -> dict[str, float]:
    """What is known of one point."""
    return {
        name: fmean(metrics[one] for one in parts)
        for name, parts in QUALITIES.items()
        if all(one in metrics for one in parts)
    }


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
        trials[point.seed] = {**point.cost, **qualities(point.metrics)}
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
