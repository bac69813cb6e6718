"""Shapes of the networks that the painter stands on: SD-Turbo's, and those a folder declares.

A folder has diffusers' layout: `unet/config.json`, `vae/config.json`, `text_encoder/config.json`.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import nn

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.painter.one_step.packages import diffusion_package

TURBO_UNET: dict[str, Any] = {
    "sample_size": 64,
    "in_channels": 4,
    "out_channels": 4,
    "block_out_channels": (320, 640, 1280, 1280),
    "attention_head_dim": (5, 10, 20, 20),
    "cross_attention_dim": 1024,
    "use_linear_projection": True,
}
"""Stable Diffusion 2.1's U-Net, which SD-Turbo has kept (Sauer et al., 2024)."""
TURBO_VAE: dict[str, Any] = {
    "in_channels": 3,
    "out_channels": 3,
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "block_out_channels": (128, 256, 512, 512),
    "layers_per_block": 2,
    "latent_channels": 4,
    "scaling_factor": 0.18215,
}
TURBO_TEXT: dict[str, Any] = {
    "vocab_size": 49408,
    "hidden_size": 1024,
    "intermediate_size": 4096,
    "num_hidden_layers": 23,
    "num_attention_heads": 16,
    "hidden_act": "gelu",
    "projection_dim": 512,
}
TEXT_TOKENS = 77


@dataclass(frozen=True, kw_only=True, eq=False)
class Architecture:
    """Configurations of the parts, as diffusers and transformers write them."""

    unet: dict[str, Any] = field(default_factory=lambda: dict(TURBO_UNET))
    vae: dict[str, Any] = field(default_factory=lambda: dict(TURBO_VAE))
    tiny: dict[str, Any] = field(default_factory=dict)
    """Of TAESD; its defaults are diffusers'."""
    text: dict[str, Any] = field(default_factory=lambda: dict(TURBO_TEXT))

    @property
    def text_width(self) -> int:
        """Features of a token."""
        return int(self.unet["cross_attention_dim"])


SD_TURBO = Architecture()


def build_unet(architecture: Architecture, num_channels: int) -> Any:  # noqa: ANN401
    """A U-Net with that many input channels, on torch's default device and of its default type."""
    diffusers = diffusion_package("diffusers")
    return diffusers.UNet2DConditionModel.from_config(
        {**architecture.unet, "in_channels": num_channels}
    )


def build_vae(architecture: Architecture) -> Any:  # noqa: ANN401
    """Stable Diffusion's autoencoder."""
    return diffusion_package("diffusers").AutoencoderKL.from_config(dict(architecture.vae))


def build_tiny(architecture: Architecture) -> Any:  # noqa: ANN401
    """The tiny autoencoder."""
    return diffusion_package("diffusers").AutoencoderTiny.from_config(dict(architecture.tiny))


def build_text_encoder(architecture: Architecture) -> nn.Module:
    """The CLIP text encoder."""
    transformers = diffusion_package("transformers")
    return transformers.CLIPTextModel(transformers.CLIPTextConfig(**architecture.text))


def read_config(folder: Path, part: str) -> dict[str, Any]:
    """The configuration of a part of a folder.

    Raises:
        WeightsError: it is missing or no JSON object.
    """
    path = folder / part / "config.json"
    try:
        config = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise WeightsError(f"no {path}: {error.strerror}; expected a diffusers folder") from None
    except ValueError as error:
        raise WeightsError(f"{path} is no JSON: {error}") from None
    if not isinstance(config, dict):
        raise WeightsError(f"{path} holds a {type(config).__name__}, expected an object")
    return config
