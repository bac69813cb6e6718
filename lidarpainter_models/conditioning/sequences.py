"""Paint the frames of a path in order, each leaning on the one painted before it.

Nothing here is random, and without a frame before it a view is painted as if it stood alone: the
first frame of a path is that painting, bit for bit. Every later frame is given the previous one,
carried over by the rendered depth (`warping`): where both views show the same surface it is either
mixed into the painting, or shown to the painter as the best of the warped images.
"""

from dataclasses import replace
from typing import NamedTuple

import torch

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.settings import SequenceConfig
from lidarpainter_models.conditioning.warping import SourceImage, WarpTarget, warped_references
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.painter.one_step.painter import OneStepPainter
from lidarpainter_models.painter.protocol import (
    DEFAULT_PROMPT,
    Painter,
    Painting,
    PaintingConditions,
)

PREVIOUS_KEY = (-1, "previous")
SHARE = 0.5  # of the previous frame in a mixed pixel on which both agree
AGREEMENT = 0.05  # mean absolute rgb difference of both at which that share has fallen to 1/e


class PaintedFrame(NamedTuple):
    """One view of a path."""

    conditions: PaintingConditions
    """Without the previous frame."""
    painting: Painting


class SequencePainter:
    """Paints one path of one camera; keeps the last frame, so each path needs its own."""

    def __init__(
        self,
        builder: ConditionBuilder,
        painter: Painter,
        *,
        config: SequenceConfig | None = None,
        camera_name: str | None = None,
        prompt: str = DEFAULT_PROMPT,
    ) -> None:
        """Begin a path.

        `config` says what becomes of previous frames; all images take the exposure of
        `camera_name`.
        """
        self._builder = builder
        self._painter = painter
        self._config = config or SequenceConfig()
        self._camera_name = camera_name
        self._prompt = prompt
        self._previous: SourceImage | None = None

    @property
    def goes_in_order(self) -> bool:
        """Whether views must be painted one after the other, in their order.

        So they are by the one-step painter too, whose network has work for all threads.
        """
        return self._config.previous != "unused" or isinstance(self._painter, OneStepPainter)

    def paint(self, camera: Camera, timestamp_ns: int) -> PaintedFrame:
        """Paint the next view of the path."""
        conditions = self._builder.conditions(
            camera, timestamp_ns, camera_name=self._camera_name, prompt=self._prompt
        )
        return PaintedFrame(conditions, self.paint_conditions(conditions, camera, timestamp_ns))

    def paint_conditions(
        self, conditions: PaintingConditions, camera: Camera, timestamp_ns: int
    ) -> Painting:
        """Paint the next view, whose conditions were gathered before."""
        timestamp_ns = camera.taken_ns(timestamp_ns)
        with torch.inference_mode():
            painting = self._painted(conditions, camera, timestamp_ns)
        if self._config.previous != "unused":
            self._previous = SourceImage(
                key=PREVIOUS_KEY,
                camera=camera,
                timestamp_ns=timestamp_ns,
                rgb=painting.rgb,
                depth_m=conditions.render_depth_m,
                alpha=conditions.render_alpha,
            )
        return painting

    def _painted(
        self, conditions: PaintingConditions, camera: Camera, timestamp_ns: int
    ) -> Painting:
        if self._previous is None:
            return self._painter.paint(conditions)
        target = WarpTarget.of_render(
            camera, timestamp_ns, conditions.render_depth_m, conditions.render_alpha
        )
        carried, valid = warped_references(target, [self._previous], self._builder.boxes, count=1)
        if self._config.previous == "shown":
            shown = replace(
                conditions,
                warp_rgb=torch.cat([carried, conditions.warp_rgb]),
                warp_valid=torch.cat([valid, conditions.warp_valid]),
            )
            return self._painter.paint(shown)
        painting = self._painter.paint(conditions)
        difference = (carried[0] - painting.rgb).abs().mean(dim=-1)
        agreed = torch.exp(-difference / AGREEMENT) * valid[0]
        share = (SHARE * agreed)[..., None]
        return replace(painting, rgb=painting.rgb + share * (carried[0] - painting.rgb))
