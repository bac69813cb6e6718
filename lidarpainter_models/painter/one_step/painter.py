"""The one-step painter as users meet it: one view in, one repaired view out.

Views of any size: edges are repeated up to multiples of 64 pixels and cut off again.
"""

from threading import Lock
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.painter.baselines import DISAGREEMENT_SCALE
from lidarpainter_models.painter.batches import ConditionBatch, stack_conditions
from lidarpainter_models.painter.one_step.autoencoder import CELL_PX
from lidarpainter_models.painter.one_step.config import OneStepConfig
from lidarpainter_models.painter.one_step.network import OneStepNetwork
from lidarpainter_models.painter.one_step.prompts import PromptBook
from lidarpainter_models.painter.protocol import Painting, PaintingConditions

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


STRIDE_PX = 64
"""Autoencoder and U-Net halve an image six times."""
NUM_WARPS = 2
"""Warped images that are looked at, best first."""
BRIGHT = 0.2
"""A LiDAR pixel darker than this in every colour counts as empty in the authors' program."""


class OneStepPainter:
    """Repairs a view in one step of a diffusion model, guided by LiDAR.

    Confidence: how well what was seen supports the painted colour, exp(-d / 0.1) with d the mean
    absolute rgb difference: to the LiDAR colour where a point hits, or to the render times its
    opacity, whichever is larger. It says nothing of what neither saw, and is not calibrated.
    """

    name = "one-step"

    def __init__(
        self, network: OneStepNetwork, prompts: PromptBook, provenance: dict[str, Any]
    ) -> None:
        """Take a network with its weights.

        It is frozen and laid out for speed here.
        """
        frozen = network.eval().requires_grad_(False)
        # torch's stub lacks memory_format
        self.network: OneStepNetwork = frozen.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.prompts = prompts
        self.provenance = provenance
        self._graphed = GraphedNetwork(self.network)
        self._alone = Lock()  # several threads would need the memory several times

    @property
    def precision(self) -> torch.dtype:
        """Of its weights."""
        return next(self.network.autoencoder.parameters()).dtype

    def to(self, device: torch.device) -> "OneStepPainter":
        """Move the network; on CUDA it is then replayed as a graph for each size of image."""
        self.network.to(device)
        self._graphed = GraphedNetwork(self.network)
        return self

    @torch.inference_mode()
    def paint(self, conditions: PaintingConditions) -> Painting:
        """Repair one view of any size.

        Raises:
            ConfigError: the prompt is new and there is no text encoder.
        """
        device = self.network.denoiser.timestep.device
        home = conditions.render_rgb.device
        text = self.prompts.encode(conditions.prompt).to(device)[None]
        batch = stack_conditions([conditions], num_sources=NUM_WARPS).to(device)
        images, masks = painter_inputs(batch, self.network.config)
        with self._alone:
            rgb = self._graphed(images, text, masks)
        height_px, width_px = conditions.height_width_px
        rgb = rgb[..., :height_px, :width_px].clamp(0, 1)
        confidence = support(batch, rgb)[0]
        return Painting(
            rgb=rgb[0].permute(1, 2, 0).contiguous().to(home), confidence=confidence.to(home)
        )


def painter_inputs(
    batch: ConditionBatch, config: OneStepConfig
) -> tuple[
    Float[Tensor, "inputs batch 3 padded_height padded_width"],
    Float[Tensor, "batch masks rows columns"] | None,
]:
    """The images and masks that a network of this configuration sees, padded."""
    found = {
        "render": batch.render,
        "lidar": _lidar_image(batch, config),
        "warp": _first_valid_warp(batch, batch.render if "render" in config.inputs else None),
    }
    images = torch.stack([_padded(found[name]) for name in config.inputs])
    if not config.masks:
        return images, None
    any_warp = batch.warp_valid.amax(dim=1, keepdim=True)
    shares = torch.cat([batch.lidar_hit, any_warp], dim=1)
    return images, F.avg_pool2d(_padded(shares), CELL_PX)


def support(
    batch: ConditionBatch, rgb: Float[Tensor, "batch 3 height width"]
) -> Float[Tensor, "batch height width"]:
    """How well render and LiDAR support a colour, in [0, 1]; see `OneStepPainter`."""
    by_render = _agreement(rgb, batch.render) * batch.render_alpha[:, 0].clamp(0, 1)
    by_lidar = _agreement(rgb, batch.lidar) * batch.lidar_hit[:, 0]
    return torch.maximum(by_render, by_lidar)


def _agreement(
    rgb: Float[Tensor, "batch 3 height width"], other: Float[Tensor, "batch 3 height width"]
) -> Float[Tensor, "batch height width"]:
    return torch.exp(-(rgb - other).abs().mean(dim=1) / DISAGREEMENT_SCALE)


def _lidar_image(
    batch: ConditionBatch, config: OneStepConfig
) -> Float[Tensor, "batch 3 height width"]:
    if config.lidar == "pure":
        return batch.lidar
    if config.lidar == "over-render":
        return torch.where(batch.lidar_hit > 0, batch.lidar, batch.render)
    is_bright = (batch.lidar > BRIGHT).any(dim=1, keepdim=True)
    return torch.where(is_bright, batch.lidar, batch.render)


def _first_valid_warp(
    batch: ConditionBatch, elsewhere: Float[Tensor, "batch 3 height width"] | None
) -> Float[Tensor, "batch 3 height width"]:
    """The best recorded image that is valid in each pixel; black by default where none is."""
    image = torch.zeros_like(batch.render) if elsewhere is None else elsewhere
    for source in reversed(range(batch.warp.shape[1])):
        is_valid = batch.warp_valid[:, source, None] > 0
        image = torch.where(is_valid, batch.warp[:, source], image)
    return image


def _padded(
    image: Float[Tensor, "batch channels height width"],
) -> Float[Tensor, "batch channels padded_height padded_width"]:
    """Repeat the lower and right edge up to multiples of the stride."""
    height_px, width_px = image.shape[2:]
    margins = (0, -width_px % STRIDE_PX, 0, -height_px % STRIDE_PX)
    return F.pad(image, margins, mode="replicate")
