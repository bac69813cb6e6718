"""Weights files of the small painter: safetensors in float16 with everything needed to use them.

The header's metadata carries the format, the network's settings, the licence and the provenance as
JSON, so a file says by itself what it is and what it was trained on.
"""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.painter.nano.network import NanoConfig, NanoNetwork
from lidarpainter_models.painter.nano.painter import NanoPainter
from lidarpainter_models.painter.weight_reading import check_header, fill_from_file
from lidarpainter_models.storage.tensor_files import open_tensors, write_tensors

WEIGHTS_FORMAT = "lidarpainter-nano/1"
CPU = torch.device("cpu")
LARGEST_FLOAT16 = torch.finfo(torch.float16).max


def save_weights(
    network: NanoNetwork, path: Path, *, licence: str, provenance: dict[str, Any]
) -> None:
    """Write a network's weights aside and rename them whole.

    Raises:
        WeightsError: a weight is not finite or too large for float16.
        WriteError: the file cannot be written.
    """
    tensors: dict[str, Tensor] = {}
    for name, tensor in network.state_dict().items():
        if not bool((tensor.abs() <= LARGEST_FLOAT16).all()):
            raise WeightsError(f"weight {name!r} of {path} is not a finite float16 number")
        tensors[name] = tensor.detach().cpu().to(torch.float16).contiguous()
    header = {
        "format": WEIGHTS_FORMAT,
        "config": network.config.to_dict(),
        "licence": licence,
        "provenance": provenance,
    }
    write_tensors(path, tensors, header)


def load_weights(
    path: Path, *, device: torch.device = CPU, precision: torch.dtype | None = None
) -> NanoPainter:
    """Read a painter from its weights file; it paints in the faster precision unless one is said.

    Raises:
        WeightsError: the file is missing, damaged, or holds another network.
    """
    with open_tensors(path, damaged=WeightsError) as (_, header):
        check_header(path, header, WEIGHTS_FORMAT, {"config", "licence", "provenance"})
    try:
        network = NanoNetwork(NanoConfig.from_dict(header["config"]))
    except (KeyError, TypeError, ValueError) as error:  # a ConfigError is a ValueError
        raise WeightsError(f"weights file {path} has unusable settings: {error}") from None
    fill_from_file(network, path, dtype=torch.float32)
    provenance = header["provenance"] | {"licence": header["licence"]}
    return NanoPainter(network.to(device), provenance=provenance, precision=precision)
