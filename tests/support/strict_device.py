"""A second device on a machine without one: what would fail or wait on a GPU fails or counts here.

Its tensors hold numbers of the CPU behind torch's dispatcher: `.device` says "strict", autograd
runs on it, factories with `device=` make its tensors. An operation that is given a tensor of the
CPU beside its own is refused, but for single numbers (0-dim), as CUDA does; so is one that wants
its memory (`numpy`). Whatever makes the host wait is counted, with the line that asked for it:
numbers carried back (`item`, `tolist`, `cpu`, `bool`), sizes that follow from numbers (`nonzero`,
choices by mask), and copies to the device that are not `non_blocking`. The rasteriser, which is
numba's here, is left out of it.
"""

import traceback
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from lidarpainter_models.kernels import gaussian_raster
from lidarpainter_models.kernels.backends import RASTERISER
from lidarpainter_models.kernels.gaussian_raster import Splats
from lidarpainter_models.kernels.gaussian_raster import cpu as numba_raster
from lidarpainter_models.painter.nano.painter import NanoPainter

NAME = "strict"
_ATEN = torch.ops.aten
_WAITING = {
    _ATEN._local_scalar_dense.default,
    _ATEN.nonzero.default,
    _ATEN.masked_select.default,
    _ATEN.equal.default,
    _ATEN._unique2.default,
    _ATEN.unique_dim.default,
    _ATEN.unique_consecutive.default,
    _ATEN.bincount.default,
}
_INDEXING = {
    _ATEN.index.Tensor,
    _ATEN.index_put.default,
    _ATEN.index_put_.default,
    _ATEN._index_put_impl_.default,
}

waits: Counter[str] = Counter()
"""How often the host waited, by the line of the library that made it."""


class StrictTensor(Tensor):
    """A tensor of the device; its numbers are `held` on the CPU."""

    held: Tensor
    __torch_function__: Any = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, held: Tensor) -> "StrictTensor":
        made = Tensor._make_wrapper_subclass(
            cls,
            held.shape,
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=torch.device(NAME, 0),
        )
        made.held = held
        _hold(made)
        return made

    def __repr__(self) -> str:  # type: ignore[override]  # mypy forgets names of its options
        return f"StrictTensor({self.held!r})"

    def tolist(self) -> Any:
        """One copy, as CUDA does it."""
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]  # torch calls it so, whatever its stub says
        cls, func, types, args=(), kwargs=None
    ):
        return _run(func, args, kwargs or {})


@dataclass
class Memory:
    """Bytes that tensors of the device hold."""

    now: int = 0
    bytes: int = 0
    """At most at any time."""
    holders: Counter[int] = field(default_factory=Counter)
    """Tensors by where their numbers lie."""


_memory = Memory()


def _hold(tensor: StrictTensor) -> None:
    """Count a tensor's numbers as long as one tensor has them."""
    storage = tensor.held.untyped_storage()
    place, size = storage.data_ptr(), storage.nbytes()
    if _memory.holders[place] == 0:
        _memory.now += size
        _memory.bytes = max(_memory.bytes, _memory.now)
    _memory.holders[place] += 1

    def drop() -> None:
        _memory.holders[place] -= 1
        if _memory.holders[place] == 0:
            _memory.now -= size

    weakref.finalize(tensor, drop)


@contextmanager
def most_held() -> Iterator[Memory]:
    """The memory, its largest taken from here on."""
    _memory.bytes = _memory.now
    yield _memory


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """One operation on the device, from it or to it."""
    flat, spec = _pytree.tree_flatten((args, kwargs))
    given = [value for value in flat if isinstance(value, Tensor)]
    own = [value for value in given if isinstance(value, StrictTensor)]
    is_copy = func in (_ATEN._to_copy.default, _ATEN.copy_.default)
    strange = [value for value in given if not isinstance(value, StrictTensor) and value.ndim]
    if own and strange and not is_copy:
        raise RuntimeError(f"{func}: {tuple(strange[0].shape)} of the CPU meets a device's tensors")
    goes_home = is_copy and _target(func, args, kwargs) != NAME
    _count(func, args, kwargs, goes_home=goes_home)
    plain = [value.held if isinstance(value, StrictTensor) else value for value in flat]
    plain = [torch.device("cpu") if isinstance(value, torch.device) else value for value in plain]
    plain_args, plain_kwargs = _pytree.tree_unflatten(plain, spec)
    found = func(*plain_args, **plain_kwargs)
    known = {id(value.held): value for value in own}

    def wrapped(value: Any) -> Any:
        if not isinstance(value, Tensor) or goes_home:
            return value
        return known[id(value)] if id(value) in known else StrictTensor(value)

    return _pytree.tree_map(wrapped, found)


def _target(func: Any, args: Any, kwargs: dict[str, Any]) -> str:
    """Type of the device that a copy goes to."""
    if func is _ATEN.copy_.default:
        return args[0].device.type
    wanted = kwargs.get("device")
    return args[0].device.type if wanted is None else torch.device(wanted).type


def _count(func: Any, args: Any, kwargs: dict[str, Any], *, goes_home: bool) -> None:
    """Enter the operation if the host waits for it."""
    reason = func.__name__ if func in _WAITING else None
    if func in _INDEXING and any(i is not None and i.dtype == torch.bool for i in args[1]):
        reason = "index by mask"
    if func is _ATEN.repeat_interleave.Tensor and kwargs.get("output_size") is None:
        reason = "repeat_interleave"
    if goes_home:
        reason = "to the CPU"
    elif func in (_ATEN._to_copy.default, _ATEN.copy_.default):
        source = args[1] if func is _ATEN.copy_.default else args[0]
        is_queued = kwargs.get("non_blocking") or (len(args) > 2 and args[2])
        if not isinstance(source, StrictTensor) and source.ndim and not is_queued:
            reason = "to the device"
    if reason is not None:
        lines = [
            f"{frame.filename.split('lidarpainter_models/')[-1]}:{frame.lineno}"
            for frame in traceback.extract_stack()
            if "lidarpainter_models/" in frame.filename
        ]
        place = lines[-1] if lines else "the test"
        if RASTERISER not in place:
            waits[f"{reason} at {place}"] += 1


@cache
def strict_device() -> torch.device:
    """The device; it exists in a process from the first call on."""
    _setup_privateuseone_for_python_backend(NAME)
    getattr(torch, NAME).get_amp_supported_dtype = lambda: [torch.bfloat16]
    library = torch.library.Library("_", "IMPL")
    library.fallback(lambda func, *args, **kwargs: _run(func, args, kwargs), "PrivateUse1")
    _kept.append(library)
    return torch.device(NAME, 0)


_kept: list[torch.library.Library] = []


class _ToHost(torch.autograd.Function):
    """Numbers of the device without a wait: this is the rasteriser's own business."""

    @staticmethod
    def forward(_ctx: Any, value: StrictTensor) -> Tensor:
        return value.held.detach().clone()

    @staticmethod
    def backward(_ctx: Any, gradient: Tensor) -> Tensor:
        return StrictTensor(gradient)


class _FromHost(torch.autograd.Function):
    @staticmethod
    def forward(_ctx: Any, value: Tensor) -> Tensor:
        return StrictTensor(value.detach().clone())

    @staticmethod
    def backward(_ctx: Any, gradient: StrictTensor) -> Tensor:
        return gradient.held


def _draw_view(splats: Splats, features, bodies, camera, out):
    """The rasteriser of the device: numba's."""
    names = ("means", "rotation_wxyz", "scale_m", "opacity", "sh", "body_index")
    own = Splats(**{name: _ToHost.apply(getattr(splats, name)) for name in names})
    held_out = None if out is None else out.held
    drawn = numba_raster.draw_view(
        own, _ToHost.apply(features), _ToHost.apply(bodies), camera, held_out
    )
    return tuple(_FromHost.apply(image) for image in drawn)


@contextmanager
def strict_runs(patch: Any) -> Iterator[torch.device]:
    """The device with a rasteriser; `waits` begins empty."""
    device, chosen, make = strict_device(), gaussian_raster.implementation, torch.tensor

    def implementation(kernel: str, name: str, backend: Any, where: torch.device) -> Callable:
        return _draw_view if where.type == NAME else chosen(kernel, name, backend, where)

    def tensor(data: Any, *, dtype=None, device=None, requires_grad=False) -> Tensor:
        made = make(data, dtype=dtype, requires_grad=requires_grad)
        return made if device is None else made.to(device)

    patch.setattr(gaussian_raster, "implementation", implementation)
    patch.setattr(torch, "tensor", tensor)  # torch's own reaches no fallback written in Python
    # inference tensors are no wrappers' business
    patch.setattr(torch, "inference_mode", torch.no_grad)
    patch.setattr(NanoPainter, "paint", torch.no_grad()(vars(NanoPainter.paint)["__wrapped__"]))
    waits.clear()
    # threads of devices are made at a process's first backward pass, perhaps before this device
    with torch.autograd.set_multithreading_enabled(False):
        yield device
