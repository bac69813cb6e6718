"""Reading safetensors straight into a network: checked by name and shape, one tensor at a time.

A file is mapped into memory while it is read; opening it anew after every 128 MB lets those pages
go, so a float32 file never lies beside the bfloat16 weights that it becomes.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Set
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.storage.tensor_files import open_tensors

PORTION_NUMBERS = 1 << 25
"""Numbers that are read before the file is opened anew: 128 MB of float32."""

Adapt = Callable[[str, Tensor], Tensor]
"""Makes a stored tensor fit the network: its name in the network, the tensor."""


def fill_from_file(
    module: nn.Module,
    path: Path,
    *,
    dtype: torch.dtype,
    renamed: Callable[[str], str] = str,
    widened: Mapping[str, tuple[int, ...]] | None = None,
    adapt: Adapt | None = None,
) -> None:
    """Give a module on the meta device the weights of a file.

    Every parameter of it must stand in the file, under a name that `renamed` makes the module's,
    and nothing else. Weights may have the `widened` shapes there; `adapt`, applied to
    every tensor, makes them fit.

    Raises:
        WeightsError: a weight is missing, too many, of a wrong shape, or not finite.
    """
    expected = {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}
    with open_tensors(path, damaged=WeightsError) as (file, _):
        shapes = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
    stored = {renamed(name): (name, shape) for name, shape in shapes.items()}
    check_shapes(path, {name: shape for name, (_, shape) in stored.items()}, expected, widened)
    # all of it before the first read: read buffers between them would leave holes behind
    weights = {name: torch.empty(shape, dtype=dtype) for name, shape in expected.items()}
    for names in _portions({name: shape for name, (_, shape) in stored.items()}):
        with open_tensors(path, damaged=WeightsError) as (file, _):
            for name in names:
                tensor = file.get_tensor(stored[name][0])
                check_finite(path, name, tensor)
                weights[name].copy_(adapt(name, tensor) if adapt else tensor)
                del tensor
    module.load_state_dict(weights, assign=True)


def _portions(shapes: Mapping[str, tuple[int, ...]]) -> Iterator[list[str]]:
    """Names of tensors in groups that together hold few numbers, or one tensor that holds many."""
    portion: list[str] = []
    total = 0
    for name, shape in shapes.items():
        total += math.prod(shape)
        portion.append(name)
        if total >= PORTION_NUMBERS:
            yield portion
            portion, total = [], 0
    if portion:
        yield portion


def check_shapes(
    path: Path,
    found: Mapping[str, tuple[int, ...]],
    expected: Mapping[str, tuple[int, ...]],
    widened: Mapping[str, tuple[int, ...]] | None = None,
) -> None:
    """Compare names and shapes.

    Raises:
        WeightsError: the first weight that differs.
    """
    for name in sorted(expected.keys() | found.keys()):
        fits = (expected.get(name), (widened or {}).get(name))
        if found.get(name) is None or found[name] not in fits:
            raise WeightsError(
                f"weights file {path}: tensor {name!r} has shape {found.get(name)}, "
                f"expected {expected.get(name)}"
            )


def check_finite(path: Path, name: str, tensor: Tensor) -> None:
    """Refuse a weight that is not a number.

    Raises:
        WeightsError: it is not.
    """
    if not tensor.is_floating_point() or not bool(tensor.isfinite().all()):
        raise WeightsError(f"weights file {path}: tensor {name!r} holds values that are no number")


def check_header(path: Path, header: Mapping[str, Any], form: str, named: Set[str]) -> None:
    """Refuse a weights file of another form, or one that does not say what it is.

    Raises:
        WeightsError: it is one of these.
    """
    found = header.get("format", "no format mark")
    if found != form:
        raise WeightsError(f"weights file {path} has {found!r}, expected {form!r}")
    if missing := named - header.keys():
        raise WeightsError(f"weights file {path} lacks {sorted(missing)} in its header")
