"""Weights files of the one-step painter: what training changed, and which model it stands on.

One safetensors file under 20 MB at full size: adapters and skips in bfloat16, the U-Net's first
and last layer and the fusion in float32, and the encoded prompts. The model itself is not in it;
the header names it, with a few of its biases by which another model is found out.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lidarpainter_models.errors import ConfigError, WeightsError
from lidarpainter_models.painter.one_step.assembly import (
    FIRST_LAYER,
    FUSION,
    LAST_LAYER,
    trained_names,
)
from lidarpainter_models.painter.one_step.config import OneStepConfig
from lidarpainter_models.painter.one_step.network import OneStepNetwork
from lidarpainter_models.painter.weight_reading import check_finite, check_header, check_shapes
from lidarpainter_models.storage.tensor_files import open_tensors, read_tensors, write_tensors

WEIGHTS_FORMAT = "lidarpainter-one-step/1"
PROMPT = "prompt:"
"""What names of encoded prompts begin with."""
IN_FLOAT32 = (FIRST_LAYER, LAST_LAYER, FUSION)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainedFile:
    """A weights file as read."""

    path: Path
    config: OneStepConfig
    base: str
    mark: list[float]
    licence: str
    provenance: dict[str, Any]
    tensors: dict[str, Tensor]
    prompts: dict[str, Tensor]


@dataclass(frozen=True, kw_only=True, eq=False)
class Trainable:
    """A network with its adapters, ready to be trained, and what its weights file has to say."""

    network: OneStepNetwork
    texts: dict[str, Tensor]
    """The encoded prompts."""
    base: str
    mark: list[float]
    """Biases of the model; see `base_models.BaseParts`."""
    licence: str
    """Of the model."""
    provenance: dict[str, Any]
    """Of the weights that the training goes on from; empty for a model."""


def save_trained(made: Trainable, path: Path, *, licence: str, provenance: dict[str, Any]) -> None:
    """Write what training changed, aside and renamed whole; `provenance` holds JSON types.

    Raises:
        WeightsError: a weight is not finite.
        WriteError: the file cannot be written.
    """
    state = dict(made.network.named_parameters())
    tensors: dict[str, Tensor] = {name: state[name] for name in trained_names(made.network)}
    tensors |= {PROMPT + name: text for name, text in made.texts.items()}
    tensors = {name: tensor.to(stored_type(name)) for name, tensor in tensors.items()}
    for name, tensor in tensors.items():
        check_finite(path, name, tensor)
    header = {
        "format": WEIGHTS_FORMAT,
        "config": made.network.config.to_dict(),
        "base": made.base,
        "mark": made.mark,
        "licence": licence,
        "provenance": provenance,
    }
    write_tensors(path, tensors, header)


def stored_type(name: str) -> torch.dtype:
    """The type in which a weight is stored."""
    return torch.float32 if name.startswith(IN_FLOAT32) else torch.bfloat16


def read_trained(path: Path) -> TrainedFile:
    """Read a weights file and check its header.

    Raises:
        WeightsError: it is missing, damaged, or of another format.
    """
    stored, header = read_tensors(path, damaged=WeightsError)
    check_header(path, header, WEIGHTS_FORMAT, {"config", "base", "mark", "licence", "provenance"})
    try:
        config = OneStepConfig.from_dict(header["config"])
        mark = [float(value) for value in header["mark"]]
        provenance = {**header["provenance"]}
    except (ConfigError, TypeError, ValueError) as error:
        raise WeightsError(f"weights file {path} has unusable settings: {error}") from None
    tensors: dict[str, Tensor] = {}
    prompts: dict[str, Tensor] = {}
    for name, tensor in stored.items():
        check_finite(path, name, tensor)
        kept = prompts if name.startswith(PROMPT) else tensors
        kept[name.removeprefix(PROMPT)] = tensor.clone()
    return TrainedFile(
        path=path,
        config=config,
        base=str(header["base"]),
        mark=mark,
        licence=str(header["licence"]),
        provenance=provenance,
        tensors=tensors,
        prompts=prompts,
    )


def is_trained_file(path: Path) -> bool:
    """Whether a file says that it is one of ours; a missing or damaged one says nothing."""
    try:
        with open_tensors(path, damaged=WeightsError) as (_, header):
            return header.get("format") == WEIGHTS_FORMAT
    except WeightsError:
        return False


@torch.no_grad()
def apply_trained(network: OneStepNetwork, file: TrainedFile) -> None:
    """Put the weights of a file into a network with adapters.

    Raises:
        WeightsError: a weight is missing, too many, or of a wrong shape.
    """
    state = dict(network.named_parameters())
    names = trained_names(network)
    expected = {name: tuple(state[name].shape) for name in names}
    found = {name: tuple(tensor.shape) for name, tensor in file.tensors.items()}
    check_shapes(file.path, found, expected)
    for name in names:
        state[name].copy_(file.tensors[name])
