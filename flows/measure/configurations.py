"""What is compared by default: one thing changed at a time from given parameters."""

from dataclasses import dataclass

from flows.fleet.manifest import Configuration
from flows.parameters import ReconstructParameters

DEFAULT = "preset"
"""The parameters as they are."""


@dataclass(frozen=True, kw_only=True)
class Factor:
    """One thing of which a scene may have more or less."""

    name: str
    cost: str
    """The figure that grows with it first."""
    levels: tuple[Configuration, ...]
    """From little to much."""
    default: str
    """The level of the given parameters."""


def chart_ways(given: ReconstructParameters) -> tuple[Configuration, ...]:
    """Speed against accuracy: painters, rounds, steps, painted views, size."""
    return (
        _way(DEFAULT),
        _way("no-painter", painter="none"),
        _way("overlay", painter="overlay"),
        _way("warp", painter="warp"),
        _way("first-fit", "rounds=0"),
        _way("one-round", "rounds=1"),
        *(_steps(given, times) for times in (0.25, 0.5, 2)),
        _way("painted-views-x0.5", f"novel.every_nth={2 * given.novel.every_nth}"),
        *(_gaussians(given, times) for times in (0.5, 2)),
    )


def size_factors(given: ReconstructParameters) -> tuple[Factor, ...]:
    """No more than the scene needs: Gaussians, harmonics, steps, rounds, painted views."""
    every_nth = given.novel.every_nth
    apart = dict.fromkeys((4 * every_nth, 2 * every_nth, every_nth, max(every_nth // 2, 1)))
    return (
        Factor(
            name="gaussians",
            cost="num_gaussians",
            levels=tuple(_gaussians(given, times) for times in (0.25, 0.5, 1, 2, 4)),
            default="gaussians-x1",
        ),
        Factor(
            name="harmonics",
            cost="scene_bytes",
            levels=tuple(
                _way(f"degree-{degree}", f"fit.initialisation.sh_degree={degree}")
                for degree in range(4)
            ),
            default=f"degree-{given.fit.initialisation.sh_degree}",
        ),
        Factor(
            name="steps",
            cost="cpu_seconds",
            levels=tuple(_steps(given, times) for times in (0.25, 0.5, 1, 2)),
            default="steps-x1",
        ),
        Factor(
            name="rounds",
            cost="cpu_seconds",
            levels=tuple(
                _way(f"rounds-{rounds}", f"rounds={rounds}")
                for rounds in range(max(given.rounds, 3) + 1)
            ),
            default=f"rounds-{given.rounds}",
        ),
        Factor(
            name="painted-views",
            cost="cpu_seconds",
            levels=tuple(_way(f"every-{nth}", f"novel.every_nth={nth}") for nth in apart),
            default=f"every-{every_nth}",
        ),
    )


def _way(name: str, *settings: str, painter: str | None = None) -> Configuration:
    return Configuration(name=name, painter=painter, set=settings)


def _steps(given: ReconstructParameters, times: float) -> Configuration:
    """What a scene shows makes steps of looks."""
    return _way(
        f"steps-x{times:g}",
        f"fit.effort.looks={given.fit.effort.looks * times}",
        f"refine.effort.looks={given.refine.effort.looks * times}",
    )


def _gaussians(given: ReconstructParameters, times: float) -> Configuration:
    return _way(
        f"gaussians-x{times:g}",
        *(
            f"{name}.effort.gaussians_per_pixel={fit.effort.gaussians_per_pixel * times}"
            for name, fit in (("fit", given.fit), ("refine", given.refine))
        ),
    )
