"""Tensors and what is to be known about them in one safetensors file.

The header is JSON under a single key, because safetensors writes several in random order and a
file should follow from its content bit for bit.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save, save_file
from torch import Tensor

from lidarpainter_models.errors import DataError, LidarPainterError, WriteError
from lidarpainter_models.storage.whole_files import whole_file

HEADER_KEY = "lidarpainter"


def pack_tensors(tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> bytes:
    """The content of a file that `read_tensors` reads."""
    return save(_stored(tensors), _metadata(header))


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write tensors and a JSON-able header, aside and renamed whole.

    Raises:
        WriteError: the disk refuses.
    """
    stored, metadata = _stored(tensors), _metadata(header)
    with whole_file(path) as aside:
        try:
            save_file(stored, aside, metadata)
        except SafetensorError as error:  # its writer reports the disk's errors as text
            raise WriteError(f"{path}: cannot be written: {error}") from error


def read_tensors(
    path: Path, *, damaged: type[Exception] = DataError
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors of a file and its header; `damaged` is raised where it cannot be read."""
    with open_tensors(path, damaged=damaged) as (file, header):
        return {name: file.get_tensor(name) for name in file.keys()}, header  # noqa: SIM118


@contextmanager
def open_tensors(
    path: Path, *, damaged: type[Exception] = DataError
) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Open a file to read some of its tensors; `damaged` is raised where it cannot be read.

    Gives safetensors' own handle and the header, which is empty in a file of someone else.
    """
    if not path.is_file():
        raise damaged(f"{path} is not there: expected a .safetensors file")
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get(HEADER_KEY, "{}"))
            if not isinstance(header, dict):
                raise damaged(f"{path} has a damaged header: no object")
            yield file, header
    except LidarPainterError:
        raise
    except json.JSONDecodeError as error:
        raise damaged(f"{path} has a damaged header: {error}") from None
    except (SafetensorError, OSError) as error:
        raise damaged(f"{path} is not a readable safetensors file: {error}") from None


def grouped(tensors: Mapping[str, Tensor], separator: str = ".") -> dict[str, dict[str, Tensor]]:
    """Tensors by what their names begin with, under the rest of these."""
    groups: dict[str, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        group, _, own_name = name.partition(separator)
        groups.setdefault(group, {})[own_name] = value
    return groups


def _stored(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().cpu().contiguous() for name, value in tensors.items()}


def _metadata(header: Mapping[str, Any]) -> dict[str, str]:
    return {HEADER_KEY: json.dumps(header, sort_keys=True)}
