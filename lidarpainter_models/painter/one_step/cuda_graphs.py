"""The network replayed as a CUDA graph: one launch in place of about a thousand.

With the tiny autoencoder a fast GPU waits for launches rather than for arithmetic. A graph holds
for one shape of image, so one is captured per shape. On other devices the network simply runs.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.painter.one_step.network import OneStepNetwork

WARM_UP_RUNS = 3
"""Runs before the capture, in which libraries choose their kernels and allocate."""

_Inputs = tuple[Tensor, Tensor, Tensor | None]


class GraphedNetwork:
    """Calls a network, on CUDA through a graph that was captured at the first call of a shape."""

    def __init__(self, network: OneStepNetwork) -> None:
        self._network = network
        self._graphs: dict[tuple[tuple[int, ...], ...], _Captured] = {}

    def __call__(
        self,
        images: Float[Tensor, "inputs batch 3 height width"],
        text: Float[Tensor, "batch tokens features"],
        masks: Float[Tensor, "batch masks rows columns"] | None = None,
    ) -> Float[Tensor, "batch 3 height width"]:
        """The repaired images, not clamped."""
        if images.device.type != "cuda":
            return self._network(images, text, masks)
        shapes = tuple(tuple(one.shape) for one in (images, text, masks) if one is not None)
        if shapes not in self._graphs:
            self._graphs[shapes] = _Captured(self._network, (images, text, masks))
        return self._graphs[shapes].replay((images, text, masks))


class _Captured:
    """A graph with the memory it reads from and writes to."""

    def __init__(self, network: OneStepNetwork, inputs: _Inputs) -> None:
        self._inputs = [None if one is None else one.clone() for one in inputs]
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP_RUNS):
                network(*self._inputs)
        torch.cuda.current_stream().wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._output = network(*self._inputs)

    def replay(self, inputs: _Inputs) -> Tensor:
        for kept, given in zip(self._inputs, inputs, strict=True):
            if kept is not None and given is not None:
                kept.copy_(given)
        self._graph.replay()
        return self._output.clone()
