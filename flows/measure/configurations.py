"""What is compared by default: one thing changed at a time from a preset."""

from dataclasses import dataclass

from flows.fleet.manifest import Configuration

STARTED = 0.6875
"""Part of the Gaussians that a fit starts with, as in the presets."""


def _way(name: str, *settings: str, painter: str | None = None) -> Configuration:
    return Configuration(name=name, painter=painter, set=settings)


def _steps(fit: int, refine: int) -> tuple[str, str]:
    return f"fit.steps={fit}", f"refine.steps={refine}"


def _gaussians(budget: int) -> tuple[str, ...]:
    return (
        f"fit.initialisation.num_gaussians={round(budget * STARTED)}",
        f"fit.densification.budget={budget}",
        f"refine.densification.budget={budget}",
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
    _way("steps-x0.25", *_steps(375, 125)),
    _way("steps-x0.5", *_steps(750, 250)),
    _way("steps-x2", *_steps(3000, 1000)),
    _way("painted-views-x0.5", "novel.every_nth=4"),
    _way("gaussians-x0.5", *_gaussians(40_000)),
    _way("gaussians-x2", *_gaussians(160_000)),
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
        levels=tuple(
            _way(f"gaussians-{budget // 1000}k", *_gaussians(budget))
            for budget in (20_000, 40_000, 80_000, 160_000, 320_000)
        ),
        default="gaussians-80k",
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
        levels=tuple(
            _way(f"steps-{steps}", *_steps(steps, steps // 3)) for steps in (375, 750, 1500, 3000)
        ),
        default="steps-1500",
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
