"""Weights files of the small painter: safetensors in float16 with everything needed to use them.

The header's metadata carries the format, the network's settings, the licence and the provenance as
JSON, so a file says by itself what it is and what it was trained on.
"""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from lidarpainter_models.errors import ConfigError, StorageError, WeightsError
from lidarpainter_models.painter.nano import NanoConfig, NanoNetwork
from lidarpainter_models.painter.nano_painter import NanoPainter

WEIGHTS_FORMAT = "lidarpainter-nano/1"
LARGEST_FLOAT16 = torch.finfo(torch.float16).max


def save_weights(
    network: NanoNetwork, path: Path, *, licence: str, provenance: dict[str, Any]
) -> None:
    """Write a network's weights aside and rename them whole.

    Raises:
        WeightsError: a weight is not finite or too large for float16.
        StorageError: the file cannot be written.
    """
    tensors: dict[str, Tensor] = {}
    for name, tensor in network.state_dict().items():
        if not bool((tensor.abs() <= LARGEST_FLOAT16).all()):
            raise WeightsError(f"weight {name!r} of {path} is not a finite float16 number")
        tensors[name] = tensor.detach().cpu().to(torch.float16).contiguous()
    metadata = {
        "format": WEIGHTS_FORMAT,
        "config": json.dumps(network.config.to_dict(), sort_keys=True),
        "licence": licence,
        "provenance": json.dumps(provenance, sort_keys=True),
    }
    aside = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        aside.write_bytes(save(tensors, metadata))
        aside.replace(path)
    except OSError as error:
        aside.unlink(missing_ok=True)
        raise StorageError(f"cannot write painter weights {path}: {error.strerror}") from error


def load_weights(path: Path) -> NanoPainter:
    """Read a painter from its weights file, on the CPU.

    Raises:
        WeightsError: the file is missing, damaged, or holds another network.
    """
    metadata, tensors = _read(path)
    config = _config_of(metadata, path)
    network = NanoNetwork(config)
    expected = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    found = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    for name in sorted(expected.keys() | found.keys()):
        if expected.get(name) != found.get(name):
            raise WeightsError(
                f"weights file {path}: tensor {name!r} has shape {found.get(name)}, "
                f"expected {expected.get(name)}"
            )
    if not all(bool(tensor.isfinite().all()) for tensor in tensors.values()):
        raise WeightsError(f"weights file {path} holds values that are not finite")
    network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    provenance = json.loads(metadata.get("provenance", "{}"))
    return NanoPainter(network, provenance=provenance | {"licence": metadata.get("licence")})


def _read(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    if not path.is_file():
        raise WeightsError(f"no painter weights at {path}: expected a .safetensors file")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path} is not a readable safetensors file: {error}") from None
    found = metadata.get("format", "no format mark")
    if found != WEIGHTS_FORMAT:
        raise WeightsError(f"weights file {path} has {found!r}, expected {WEIGHTS_FORMAT!r}")
    return metadata, tensors


def _config_of(metadata: dict[str, str], path: Path) -> NanoConfig:
    try:
        return NanoConfig.from_dict(json.loads(metadata["config"]))
    except (KeyError, ValueError) as error:  # ConfigError and JSON errors are ValueErrors
        raise WeightsError(f"weights file {path} has unusable settings: {error}") from None
