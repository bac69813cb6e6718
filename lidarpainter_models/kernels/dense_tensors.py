"""Tensors without gaps, as Triton kernels read and write them."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from torch import Tensor


@contextmanager
def dense_in_place(tensors: Sequence[Tensor]) -> Iterator[list[Tensor]]:
    """The tensors for a kernel that changes them; what had to be copied is copied back."""
    dense = [tensor.contiguous() for tensor in tensors]
    yield dense
    for tensor, changed in zip(tensors, dense, strict=True):
        if tensor is not changed:
            tensor.copy_(changed)
