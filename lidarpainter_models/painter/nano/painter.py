"""The small painter as users meet it: one view in, one repaired view out.

Runs on the device its network lies on. On a CPU the U-Net runs in bfloat16, about twice as fast as
float32; pictures, mixing and confidence stay in float32.
"""

from typing import Any

import torch

from lidarpainter_models.painter.batches import stack_conditions
from lidarpainter_models.painter.nano.network import NanoNetwork
from lidarpainter_models.painter.protocol import Painting, PaintingConditions


class NanoPainter:
    """Repairs a view by mixing what is known about it.

    Confidence: exp(-e / 0.05) with e the mean absolute error the network expects in the pixel
    (its scale is `NanoConfig.confidence_error`).
    """

    name = "nano"

    def __init__(
        self,
        network: NanoNetwork,
        *,
        provenance: dict[str, Any] | None = None,
        half_precision: bool = True,
    ) -> None:
        """Take a trained network.

        Args:
            network: the fusion network; frozen and laid out for speed here.
            provenance: where its weights come from, as stored beside them.
            half_precision: run the convolutions in bfloat16.
        """
        frozen = network.eval().requires_grad_(False)
        # torch's stub lacks memory_format
        self.network = frozen.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.provenance = provenance or {}
        self.half_precision = half_precision

    @torch.inference_mode()
    def paint(self, conditions: PaintingConditions) -> Painting:
        """Repair one view of any size.

        Raises:
            ConfigError: the network was not trained for the prompt.
        """
        config = self.network.config
        device = self.network.head.weight.device
        batch = stack_conditions([conditions], num_sources=config.num_sources).to(device)
        output = self.network(batch, [conditions.prompt], half_precision=self.half_precision)
        confidence = torch.exp(-output.log_error[0].exp() / config.confidence_error)
        home = conditions.render_rgb.device
        return Painting(
            rgb=output.rgb[0].permute(1, 2, 0).clamp(0, 1).contiguous().to(home),
            confidence=confidence.to(home),
        )
