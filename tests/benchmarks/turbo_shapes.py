"""Shapes of SD-Turbo, and text encoders of random weights, for what is measured without a model."""

from dataclasses import dataclass
from typing import Any

from torch import nn

from lidarpainter_models.painter.one_step.architectures import Architecture, diffusion_package

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


@dataclass(frozen=True, kw_only=True, eq=False)
class WholeModel(Architecture):
    """A model with its text encoder."""

    text: dict[str, Any]


SD_TURBO = WholeModel(unet=TURBO_UNET, vae=TURBO_VAE, tiny={}, text=TURBO_TEXT)


def build_text_encoder(model: WholeModel) -> nn.Module:
    """The CLIP text encoder."""
    transformers = diffusion_package("transformers")
    return transformers.CLIPTextModel(transformers.CLIPTextConfig(**model.text))
