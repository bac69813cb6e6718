"""Tensors and their metadata in one safetensors file.

Everything in the library that is stored gives `(arrays, metadata)` and is rebuilt from them; here
the arrays become the tensors of a file and the metadata JSON in its header.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from catalog.errors import DamagedArtefactError

METADATA_KEY = "lidarpainter"


def write_tensors(path: Path, arrays: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
    """Write arrays and JSON-able metadata to a file."""
    own = {name: value.detach().cpu().contiguous() for name, value in arrays.items()}
    path.write_bytes(save(own, {METADATA_KEY: json.dumps(metadata, allow_nan=False)}))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `write_tensors` wrote.

    Raises:
        DamagedArtefactError: the file is missing or is no such file.
    """
    try:
        with safe_open(path, framework="pt") as file:
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            metadata = json.loads((file.metadata() or {})[METADATA_KEY])
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise DamagedArtefactError(f"{path} cannot be read: {error}") from None
    return arrays, metadata
