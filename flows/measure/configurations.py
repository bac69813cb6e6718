"""What is compared by default: one thing changed at a time from a preset."""

from dataclasses import dataclass

from flows.fleet.manifest import Configuration

LOOKS, REFINE_LOOKS, GAUSSIANS_PER_PIXEL = 300.0, 150.0, 0.3
"""The effort of the preset; what a scene shows makes steps and Gaussians of it."""


def _way(name: str, *settings: str, painter: str | None = None) -> Configuration:
    return Configuration(name=name, painter=painter, set=settings)


def _steps(times: float) -> Configuration:
    return _way(
        f"steps-x{times:g}",
        f"fit.effort.looks={LOOKS * times}",
        f"refine.effort.looks={REFINE_LOOKS * times}",
    )


def _gaussians(times: float) -> Configuration:
    number = GAUSSIANS_PER_PIXEL * times
    return _way(
        f"gaussians-x{times:g}",
        *(f"{fit}.effort.gaussians_per_pixel={number}" for fit in ("fit", "refine")),
    )


DEFAULT = "preset"
"""The preset as it is."""

CHART = (
    _way(DEFAULT),
    _way("no-painter", painter="none"),
    _way("overlay", painter="overlay"),
    _way("warp", painter="warp"),
    _way("first-fit", "rounds=0"),
    _way("one-round", "rounds=1"),
    *(_steps(times) for times in (0.25, 0.5, 2)),
    _way("painted-views-x0.5", "novel.every_nth=4"),
    *(_gaussians(times) for times in (0.5, 2)),
)
"""Speed against accuracy: painters, rounds, steps, painted views, size."""


@dataclass(frozen=True, kw_only=True)
class Factor:
    """One thing of which a scene may have more or less."""

    name: str
    cost: str
    """The figure that grows with it first."""
    levels: tuple[Configuration, ...]
    """From little to much."""
    default: str
    """The level of the preset."""


SIZE = (
    Factor(
        name="gaussians",
        cost="num_gaussians",
        levels=tuple(_gaussians(times) for times in (0.25, 0.5, 1, 2, 4)),
        default="gaussians-x1",
    ),
    Factor(
        name="harmonics",
        cost="scene_bytes",
        levels=tuple(
            _way(f"degree-{degree}", f"fit.initialisation.sh_degree={degree}")
            for degree in range(4)
        ),
        default="degree-1",
    ),
    Factor(
        name="steps",
        cost="cpu_seconds",
        levels=tuple(_steps(times) for times in (0.25, 0.5, 1, 2)),
        default="steps-x1",
    ),
    Factor(
        name="rounds",
        cost="cpu_seconds",
        levels=tuple(_way(f"rounds-{rounds}", f"rounds={rounds}") for rounds in range(4)),
        default="rounds-2",
    ),
    Factor(
        name="painted-views",
        cost="cpu_seconds",
        levels=tuple(_way(f"every-{nth}", f"novel.every_nth={nth}") for nth in (8, 4, 2, 1)),
        default="every-2",
    ),
)
"""No more than the scene needs."""
