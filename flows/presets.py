"""Full parameters by name; every number of a run stands here or in the library's defaults."""

from collections.abc import Callable
from dataclasses import replace

from flows.parameters import ReconstructParameters
from lidarpainter_models.conditioning.settings import ConditionConfig, NovelGuidanceConfig
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.settings import ScoringConfig
from lidarpainter_models.gaussians.fitting.config import FitConfig, GuidanceConfig, continuation
from lidarpainter_models.observations.settings import ObservationConfig

SHORT_REFINE_STEPS = 500
"""A round of the CPU preset: fourteen looks at each of 35 painted views."""


def preview(scene: str) -> ReconstructParameters:
    """Minutes on two CPU cores."""
    fit = FitConfig()
    return ReconstructParameters(
        scene=scene,
        preset="preview",
        observation=ObservationConfig(width_px=480),
        fit=fit,
        painter="nano",
        novel=NovelGuidanceConfig(),
        conditions=ConditionConfig(),
        rounds=2,
        refine=continuation(fit, steps=SHORT_REFINE_STEPS, guidance=GuidanceConfig()),
        scoring=ScoringConfig(),
    )


def balanced(scene: str) -> ReconstructParameters:
    """The best trade on one GPU."""
    fit = FitConfig(steps=7_000)
    fit = replace(fit, densification=replace(fit.densification, budget=600_000))
    return ReconstructParameters(
        scene=scene,
        preset="balanced",
        observation=ObservationConfig(width_px=960),
        fit=fit,
        painter="nano",
        novel=NovelGuidanceConfig(),
        conditions=ConditionConfig(),
        rounds=2,
        refine=continuation(fit, steps=3_000, guidance=GuidanceConfig()),
        scoring=ScoringConfig(),
    )


def paper(scene: str) -> ReconstructParameters:
    """The paper's numbers: 7000 steps, then novel views up to step 30000, at 1024 pixels.

    Its LPIPS counts where weights are given: `--set lpips.backbone=FILE --set lpips.heads=FILE`
    with `fit.losses.perceptual=1`, `refine.losses.perceptual=1` and `refine.guidance.perceptual=1`.
    """
    fit = FitConfig(steps=7_000, half_resolution=0.0)
    guidance = GuidanceConfig(probability=0.4, weight=0.2, ssim=0.1, freedom="all")
    return ReconstructParameters(
        scene=scene,
        preset="paper",
        observation=ObservationConfig(width_px=1024),
        fit=fit,
        painter="nano",
        novel=NovelGuidanceConfig(every_nth=1),
        conditions=ConditionConfig(),
        rounds=1,
        refine=continuation(fit, steps=23_000, guidance=guidance),
        scoring=ScoringConfig(),
    )


PRESETS: dict[str, Callable[[str], ReconstructParameters]] = {
    "preview": preview,
    "balanced": balanced,
    "paper": paper,
}


def preset(name: str, scene: str) -> ReconstructParameters:
    """Parameters of a preset for a scene.

    Raises:
        ConfigError: there is no such preset.
    """
    try:
        return PRESETS[name](scene)
    except KeyError:
        raise ConfigError(f"no preset {name!r}, expected one of {', '.join(PRESETS)}") from None
