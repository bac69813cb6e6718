"""Batches in the order of their numbers, drawn ahead where another device than the CPU learns.

A GPU takes a batch in the time in which one core draws a sample. So worker processes draw there,
each batch from the seed and its number as ever, and hand it over in pinned memory. On the CPU,
where drawing and learning share the cores, a batch is drawn when it is wanted.
"""

from collections.abc import Callable, Iterator
from itertools import count

import torch
from torch.utils.data import DataLoader, Dataset

from lidarpainter_models.errors import DataError
from lidarpainter_models.painter.augmentation import TrainingBatch

Draw = Callable[[int], TrainingBatch]


def batches_in_order(
    draw: Draw, device: torch.device, *, first: int, every: int
) -> Iterator[TrainingBatch]:
    """The batches `first`, `first + every` and so on without end, on a device.

    `draw` makes the batch of a number on the CPU; it is pickled for processes that draw ahead.

    Raises:
        DataError: a batch could not be drawn; raised when its turn comes.
    """
    numbers = count(first, every)
    return map(draw, numbers) if device.type == "cpu" else _drawn_ahead(draw, device, numbers)


def _drawn_ahead(
    draw: Draw, device: torch.device, numbers: Iterator[int]
) -> Iterator[TrainingBatch]:
    loader = DataLoader(
        _Drawn(draw),
        batch_size=None,
        sampler=numbers,
        num_workers=max(1, torch.get_num_threads() - 1),  # one core is left to whoever learns
        multiprocessing_context="spawn",  # numba ends forks of a process that ran its threads
        pin_memory=device.type == "cuda",
        generator=torch.Generator(),  # the global one is left alone
    )
    for found in loader:
        if isinstance(found, DataError):
            raise found
        yield found.to(device)


class _Drawn(Dataset[TrainingBatch | DataError]):
    """Batches by number, or why one could not be drawn.

    What is raised in a worker would come back with its whole traceback as its message.
    """

    def __init__(self, draw: Draw) -> None:
        self._draw = draw

    def __getitem__(self, number: int) -> TrainingBatch | DataError:
        try:
            return self._draw(number)
        except DataError as error:
            return error
