"""Shapes of the networks that the painter stands on, as a model's folder declares them.

A folder has diffusers' layout: `unet/config.json`, `vae/config.json`. The packages of the
extra `diffusion` take 10 to 20 seconds to import, so no module imports them at its top.
"""

import json
import warnings
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from lidarpainter_models.errors import MissingPackageError, WeightsError

TEXT_TOKENS = 77


@dataclass(frozen=True, kw_only=True, eq=False)
class Architecture:
    """Configurations of the parts, as diffusers writes them."""

    unet: dict[str, Any]
    vae: dict[str, Any]
    tiny: dict[str, Any]
    """Of TAESD; its defaults are diffusers'."""

    @property
    def text_width(self) -> int:
        """Features of a token."""
        return int(self.unet["cross_attention_dim"])


def diffusion_package(name: str) -> Any:  # noqa: ANN401 - a module without type stubs
    """Import `diffusers`, `transformers`, `peft` or `huggingface_hub`.

    Raises:
        MissingPackageError: the package is not installed or cannot be imported.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # advice to their authors, not to our users
            return import_module(name)
    except ImportError as error:
        raise MissingPackageError(
            f"the one-step painter needs the package {name} ({error}): "
            "pip install 'lidarpainter[diffusion]'"
        ) from None


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
