"""Settings of the one-step painter: which inputs it sees, how its parts are wired, named wirings.

`paper` is what the paper says, `as-shipped` what its authors' program does (they differ in time,
fusion, first layer, LiDAR image and ranges), `fast` our own trade.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from types import MappingProxyType
from typing import Any, Literal, get_args

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.one_step.denoiser import FirstLayerStart
from lidarpainter_models.painter.one_step.latent_fusion import LATENT_CHANNELS, FusionConfig
from lidarpainter_models.painter.one_step.schedule import Denoise, denoising_step

INPUTS = ("render", "lidar", "warp")
"""What can enter as a latent, in this order: the corrupted render, the LiDAR image, and the
recorded images carried into the view (the first valid one; where none is, the render, or black
if the render is not to be seen)."""
NUM_MASKS = 2
"""Share of LiDAR hits and of valid warps in each latent cell."""

LARGEST_RANK = 256
"""Of an adapter; larger ones are no longer small beside their layer."""

AutoencoderKind = Literal["sd", "taesd"]
SkipSource = Literal["none", "render", "fused"]
LidarInput = Literal["pure", "over-render", "bright-over-render"]
DenoiserInput = Literal["latents", "fused"]
_CHOICES = {
    "autoencoder": get_args(AutoencoderKind),
    "denoise": get_args(Denoise),
    "skips": get_args(SkipSource),
    "first_layer": get_args(FirstLayerStart),
    "denoiser_sees": get_args(DenoiserInput),
    "lidar": get_args(LidarInput),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class OneStepConfig:
    """How the parts of the one-step painter are wired; the defaults are the paper's."""

    inputs: tuple[str, ...] = ("render", "lidar")
    """Latents that enter, a subset of `INPUTS` in that order; one of them alone is an ablation."""
    autoencoder: AutoencoderKind = "sd"
    timestep: int = 999
    """Time of the one step: 999 is SD-Turbo's own, 200 what the authors' program uses, 199 loses
    twenty times less to rounding than 999."""
    denoise: Denoise = "posterior"
    fusion: FusionConfig | None = field(default_factory=FusionConfig)
    """Weights of the latents that the step starts from; None starts from the first input alone."""
    skips: SkipSource = "render"
    """Whose features the decoder sees: the first input's, a mix weighed as the latents, or none."""
    skip_bias: bool = False
    first_layer: FirstLayerStart = "zero"
    denoiser_sees: DenoiserInput = "latents"
    """All latents side by side, or only their mix (an ablation)."""
    masks: bool = False
    """Two more channels for the U-Net: shares of LiDAR hits and of valid warps."""
    lidar: LidarInput = "pure"
    """`pure`: black where no point hits; `over-render`: the render there; `bright-over-render`: the
    render also where LiDAR is darker than 0.2, as in the authors' program."""
    is_signed: bool = True
    """Images enter in [-1, 1]; otherwise in [0, 1], as in pix2pix-turbo."""
    unet_rank: int = 8
    """Rank of the U-Net's LoRA; 0 for none."""
    autoencoder_rank: int = 4
    """Rank of the autoencoder's LoRA; 0 for none."""

    def __post_init__(self) -> None:
        if not self.inputs or tuple(name for name in INPUTS if name in self.inputs) != self.inputs:
            raise ConfigError(f"inputs must be some of {INPUTS} in this order, got {self.inputs}")
        if self.fusion is not None and len(self.inputs) == 1:
            raise ConfigError(f"one input, {self.inputs[0]!r}, needs no fusion: set it to None")
        if self.autoencoder == "taesd" and (self.skips != "none" or self.autoencoder_rank):
            raise ConfigError("the tiny autoencoder has no skips and no LoRA: set none and 0")
        if self.skips == "fused" and self.fusion is None:
            raise ConfigError("fused skips need a fusion")
        if not {self.unet_rank, self.autoencoder_rank} <= set(range(LARGEST_RANK + 1)):
            raise ConfigError(f"LoRA ranks must be in [0, {LARGEST_RANK}]")
        denoising_step(self.timestep)

    @property
    def num_latents(self) -> int:
        """Latents that the U-Net sees."""
        return 1 if self.denoiser_sees == "fused" else len(self.inputs)

    @property
    def first_layer_channels(self) -> int:
        """Input channels of the U-Net."""
        return LATENT_CHANNELS * self.num_latents + NUM_MASKS * self.masks

    def to_dict(self) -> dict[str, Any]:
        """The settings as JSON types."""
        return asdict(self) | {"inputs": list(self.inputs)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "OneStepConfig":
        """Undo `to_dict`.

        Raises:
            ConfigError: a field is missing, unknown or of a wrong value.
        """
        for name, choices in _CHOICES.items():
            if values.get(name) not in choices:
                raise ConfigError(f"{name} must be of {choices}, got {values.get(name)!r}")
        try:
            fusion = values["fusion"] and FusionConfig(**values["fusion"])
            config = cls(**values | {"inputs": tuple(values["inputs"]), "fusion": fusion})
        except (KeyError, TypeError) as error:
            raise ConfigError(f"not the settings of a one-step painter: {error}") from None
        if config.to_dict() != values:
            raise ConfigError(f"not the settings of a one-step painter: {values}")
        return config


PAPER = OneStepConfig()
"""Render and LiDAR at t = 999, attention fusion, skips of the render."""
AS_SHIPPED = OneStepConfig(
    timestep=200,
    fusion=FusionConfig(kind="as-shipped", channels=4),
    skip_bias=True,
    first_layer="copy",
    lidar="bright-over-render",
    is_signed=False,
)
"""The authors' program: t = 200, copied first layer, 1x1 fusion, LiDAR laid over the render."""
FAST = OneStepConfig(autoencoder="taesd", timestep=199, skips="none", autoencoder_rank=0)
"""The tiny autoencoder, and t = 199, which bfloat16 hardly harms."""
WITH_REFERENCE = OneStepConfig(inputs=("render", "lidar", "warp"), timestep=199, skips="fused")
"""Ours: the warped recorded images as a third latent, three-way fusion, fused skips."""
PRESETS: Mapping[str, OneStepConfig] = MappingProxyType(
    {"paper": PAPER, "as-shipped": AS_SHIPPED, "fast": FAST, "with-reference": WITH_REFERENCE}
)
