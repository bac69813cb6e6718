"""Named wirings of the one-step painter.

`paper` is what the paper says, `as-shipped` what its authors' program does (they differ in time,
fusion, first layer, LiDAR image and ranges), `fast` our own trade.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.one_step.config import OneStepConfig
from lidarpainter_models.painter.one_step.latent_fusion import FusionConfig


def paper() -> OneStepConfig:
    """Render and LiDAR at t = 999, attention fusion, skips of the render."""
    return OneStepConfig()


def as_shipped() -> OneStepConfig:
    """The authors' program: t = 200, copied first layer, 1x1 fusion, LiDAR laid over the render."""
    return OneStepConfig(
        timestep=200,
        fusion=FusionConfig(kind="as-shipped", channels=4),
        skip_bias=True,
        first_layer="copy",
        lidar="bright-over-render",
        is_signed=False,
    )


def fast() -> OneStepConfig:
    """The tiny autoencoder, and t = 199, which bfloat16 hardly harms."""
    return OneStepConfig(autoencoder="taesd", timestep=199, skips="none", autoencoder_rank=0)


def with_reference() -> OneStepConfig:
    """Ours: the warped recorded images as a third latent, three-way fusion, fused skips."""
    return OneStepConfig(inputs=("render", "lidar", "warp"), timestep=199, skips="fused")


PRESETS: Mapping[str, Callable[[], OneStepConfig]] = MappingProxyType(
    {"paper": paper, "as-shipped": as_shipped, "fast": fast, "with-reference": with_reference}
)


def preset_named(name: str) -> OneStepConfig:
    """The settings of a preset.

    Raises:
        ConfigError: there is no such preset.
    """
    if name not in PRESETS:
        raise ConfigError(f"no painter preset {name!r}: expected one of {', '.join(PRESETS)}")
    return PRESETS[name]()
