"""The model that the user brings: SD-Turbo or another in diffusers' layout, from a folder or cache.

Nothing is downloaded unless asked for. Weights are read from safetensors alone, because a pickle
may run code. Licences are the model's own and are told, never judged.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.painter.known_painters import SD_TURBO, is_hub_id
from lidarpainter_models.painter.one_step.architectures import (
    Architecture,
    build_tiny,
    build_unet,
    build_vae,
    diffusion_package,
    read_config,
)
from lidarpainter_models.painter.one_step.config import AutoencoderKind, OneStepConfig
from lidarpainter_models.painter.one_step.denoiser import widen_first_layer
from lidarpainter_models.painter.weight_reading import fill_from_file

SD_TURBO_HUB = "stabilityai/sd-turbo"
TAESD_HUB = "madebyollin/taesd"
TAESD_FOLDER = "taesd"
"""Where the tiny autoencoder lies in a model's folder; otherwise it is looked for in the cache."""
KNOWN_LICENCES = {
    SD_TURBO_HUB: "Stability AI Community License (see the model's LICENSE)",
    TAESD_HUB: "MIT",
}
UNKNOWN_LICENCE = "unknown"
WEIGHT_NAMES = ("diffusion_pytorch_model.safetensors", "diffusion_pytorch_model.fp16.safetensors")
_OLD_ATTENTION = {
    ".query.": ".to_q.",
    ".key.": ".to_k.",
    ".value.": ".to_v.",
    ".proj_attn.": ".to_out.0.",
}
"""Names in autoencoders that were written before diffusers 0.14."""
_FILES = ("*.json", "*.md", "*.txt", "LICENSE*", "*/*.json", "*/*.txt", "*.safetensors")


@dataclass(frozen=True, kw_only=True, eq=False)
class BaseModel:
    """A folder in diffusers' layout and what is known about it."""

    name: str
    """As the user gave it: a folder, or an id of the hub."""
    folder: Path
    architecture: Architecture
    licence: str


@dataclass(frozen=True, kw_only=True, eq=False)
class BaseParts:
    """The networks of a base model with their weights."""

    unet: Any
    autoencoder: Any
    mark: list[float]
    """A few biases by which the model is known again, whatever type its file has."""


def open_base(name: str, *, may_download: bool = False) -> BaseModel:
    """Find a model and read what it declares.

    The name is that of a folder, an id of the hub, or `sd-turbo`; what is downloaded goes to the
    user's cache.

    Raises:
        WeightsError: it is not there, or not in diffusers' layout.
        MissingPackageError: the extra `diffusion` is not installed.
    """
    hub_id = SD_TURBO_HUB if name == SD_TURBO else name
    folder = find_folder(hub_id, may_download=may_download)
    unet, vae = read_config(folder, "unet"), read_config(folder, "vae")
    tiny = read_config(folder, TAESD_FOLDER) if (folder / TAESD_FOLDER).is_dir() else {}
    if not isinstance(unet.get("cross_attention_dim"), int):
        raise WeightsError(f"{folder}/unet/config.json names no cross_attention_dim")
    architecture = Architecture(unet=unet, vae=vae, tiny=tiny)
    licence = read_licence(folder, hub_id, unet)
    return BaseModel(name=name, folder=folder, architecture=architecture, licence=licence)


def find_folder(name: str, *, may_download: bool = False) -> Path:
    """A model's folder: the one of that name, or the one in the user's hub cache.

    Raises:
        WeightsError: neither is there.
    """
    folder = Path(name)
    if folder.is_dir():
        return folder
    if not is_hub_id(name):
        raise WeightsError(f"no painter {name!r}: no such folder, and no id of the hub")
    hub = diffusion_package("huggingface_hub")
    patterns = [*_FILES, *(f"*/{weights}" for weights in (*WEIGHT_NAMES, "model.safetensors"))]
    try:
        found = hub.snapshot_download(
            name, local_files_only=not may_download, allow_patterns=patterns
        )
    except Exception as error:  # noqa: BLE001 - the client raises many kinds; all mean "not there"
        reason = str(error).splitlines()[0] if may_download else "nothing is downloaded unasked"
        raise WeightsError(
            f"no folder {name!r} and no such model in the hub cache ({reason}); give the folder "
            "of a copy, or fetch it once with the hub's own client"
        ) from None
    return Path(found)


def load_parts(base: BaseModel, config: OneStepConfig, *, dtype: torch.dtype) -> BaseParts:
    """Read the U-Net and the autoencoder in the type asked for.

    Raises:
        WeightsError: a weight is missing or wrong, or the configuration makes no network.
    """
    try:
        with torch.device("meta"):
            unet = build_unet(base.architecture, config.first_layer_channels)
            build = build_vae if config.autoencoder == "sd" else build_tiny
            autoencoder = build(base.architecture)
    except (TypeError, ValueError, LookupError, RuntimeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise WeightsError(
            f"the configurations in {base.folder} make no network: {reason}"
        ) from None
    first = unet.conv_in.weight
    narrow = (first.shape[0], 4, *first.shape[2:])

    def adapt(name: str, tensor: Tensor) -> Tensor:
        if name == "conv_in.weight" and tuple(tensor.shape) == narrow:
            return widen_first_layer(tensor, first.shape[1], config.first_layer)
        return tensor

    fill_from_file(
        unet,
        weights_file(base.folder / "unet"),
        dtype=dtype,
        widened={"conv_in.weight": narrow},
        adapt=adapt,
    )
    place = autoencoder_folder(base.folder, config.autoencoder)
    fill_from_file(autoencoder, weights_file(place), dtype=dtype, renamed=_without_old_names)
    for part in (unet, autoencoder):
        part.requires_grad_(False)
    mark = _mark(unet, autoencoder, config.autoencoder)
    return BaseParts(unet=unet, autoencoder=autoencoder, mark=mark)


def autoencoder_folder(folder: Path, kind: AutoencoderKind) -> Path:
    """Where the weights of the autoencoder lie.

    Raises:
        WeightsError: the tiny one is neither in the folder nor in the user's cache.
    """
    if kind == "sd":
        return folder / "vae"
    own = folder / TAESD_FOLDER
    return own if own.is_dir() else find_folder(TAESD_HUB)


def weights_file(folder: Path) -> Path:
    """The weights of a part, the full ones before those in float16.

    Raises:
        WeightsError: there are none that can be read safely.
    """
    for name in WEIGHT_NAMES:
        if (folder / name).is_file():
            return folder / name
    pickles = sorted(path.name for path in folder.glob("*.bin"))
    also = f"; {pickles[0]} is a pickle, which is not read" if pickles else ""
    raise WeightsError(f"no weights in {folder}: expected {WEIGHT_NAMES[0]}{also}")


def model_files(base: BaseModel, kind: AutoencoderKind) -> list[Path]:
    """The files of a model that a painter is made of.

    Raises:
        WeightsError: some are not there.
    """
    autoencoder = autoencoder_folder(base.folder, kind)
    parts = [base.folder / "unet", autoencoder]
    files = [path for part in parts for path in (part / "config.json", weights_file(part))]
    for folder in (base.folder / "text_encoder", base.folder / "tokenizer"):
        files += sorted(path for path in folder.glob("*") if path.is_file())
    return files


def read_licence(folder: Path, hub_id: str, config: dict[str, Any]) -> str:
    """What the model's card or licence file says, or what is known of the model."""
    card = folder / "README.md"
    if card.is_file():
        head = card.read_text("utf-8", errors="replace").split("\n---", 1)[0]
        found: dict[str, str] = dict(
            re.findall(r"^(license|license_name): *([\w.-]+)", head, re.MULTILINE)
        )
        if found:
            return found.get("license_name", found.get("license", UNKNOWN_LICENCE))
    for path in sorted(folder.glob("LICENSE*")):
        lines = [line.strip("# ") for line in path.read_text("utf-8", errors="replace").split("\n")]
        first = next((line for line in lines if line), "")
        if first:
            return first[:200]
    origin = str(config.get("_name_or_path", ""))
    return KNOWN_LICENCES.get(hub_id, KNOWN_LICENCES.get(origin, UNKNOWN_LICENCE))


def _without_old_names(name: str) -> str:
    for old, new in _OLD_ATTENTION.items():
        name = name.replace(old, new)
    return name


def _mark(unet: Any, autoencoder: Any, kind: AutoencoderKind) -> list[float]:  # noqa: ANN401
    last = autoencoder.encoder.conv_out if kind == "sd" else autoencoder.encoder.layers[-1]
    return [float(value) for bias in (unet.conv_out.bias, last.bias) for value in bias.float()]
