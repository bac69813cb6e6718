"""Full parameters by name: an effort and a width, from which steps and Gaussians follow.

Every number of a run stands here or in the library's defaults.
"""

from collections.abc import Callable

from flows.parameters import ReconstructParameters
from lidarpainter_models.conditioning.settings import (
    PAPER_SHIFTS,
    ConditionConfig,
    NovelGuidanceConfig,
)
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.settings import ScoringConfig
from lidarpainter_models.gaussians.fitting.config import (
    EffortConfig,
    FitConfig,
    GuidanceConfig,
    continuation,
)
from lidarpainter_models.observations.settings import ObservationConfig

SHORT_REFINE_LOOKS = 150.0
"""A round of the CPU preset: on one front camera six looks at each of 35 painted views."""


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
        refine=continuation(fit, looks=SHORT_REFINE_LOOKS, guidance=GuidanceConfig()),
        scoring=ScoringConfig(),
    )


def brief(scene: str) -> ReconstructParameters:
    """Half the steps of `preview` and an eighth fewer Gaussians: what the demo shows."""
    fit = FitConfig(effort=EffortConfig(looks=150.0, gaussians_per_pixel=0.2))
    refine = continuation(fit, looks=SHORT_REFINE_LOOKS / 2, guidance=GuidanceConfig())
    return preview(scene).model_copy(update={"preset": "brief", "fit": fit, "refine": refine})


def balanced(scene: str) -> ReconstructParameters:
    """The best trade for a whole log: twice as fine, in half an hour on two CPU cores.

    Fewer Gaussians for each pixel, half of the steps at half the size, and one painted round of
    fewer views.
    """
    effort = EffortConfig(looks=450.0, gaussians_per_pixel=0.125)
    fit = FitConfig(effort=effort, half_resolution=0.5)
    changes = {
        "preset": "balanced",
        "observation": ObservationConfig(width_px=960),
        "fit": fit,
        "novel": NovelGuidanceConfig(every_nth=4),
        "rounds": 1,
        "refine": continuation(fit, looks=75.0, guidance=GuidanceConfig()),
    }
    return preview(scene).model_copy(update=changes)


def paper(scene: str) -> ReconstructParameters:
    """The paper's schedule: 7 parts recorded views alone, 23 with novel ones, 1024 pixels wide.

    Cameras are moved as the paper moves them and none is turned; pixels are weighed as in the other
    presets, by trust.

    Its LPIPS counts where weights are given: `--set lpips.backbone=FILE --set lpips.heads=FILE`
    with `fit.losses.perceptual=1`, `refine.losses.perceptual=1` and `refine.guidance.perceptual=1`.
    """
    fit = FitConfig(effort=EffortConfig(looks=3_500.0), half_resolution=0.0)
    guidance = GuidanceConfig(probability=0.4, weight=0.2, ssim=0.1)
    changes = {
        "preset": "paper",
        "observation": ObservationConfig(width_px=1024),
        "fit": fit,
        "novel": NovelGuidanceConfig(every_nth=1, shifts=PAPER_SHIFTS),
        "rounds": 1,
        "refine": continuation(fit, looks=11_500.0, guidance=guidance),
    }
    return preview(scene).model_copy(update=changes)


PRESETS: dict[str, Callable[[str], ReconstructParameters]] = {
    one.__name__: one for one in (brief, preview, balanced, paper)
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
