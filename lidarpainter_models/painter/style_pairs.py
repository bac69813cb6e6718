"""Pairs whose target is in another style, so that one painter learns to restore and to restyle.

The conditions stay clear and carry the prompt; the target is styled by the depth of its own view:
LiDAR where it hit, the render elsewhere. Pairs keep no camera, so depth stands for distance, and
what needs to know the ground (the low beam, windows, wet roads) is left out.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from lidarpainter_models.painter.examples import PaintingPair
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT, PaintingConditions
from lidarpainter_models.painter.styles import StyleView, apply_style


def styled_pair(pair: PaintingPair, prompt: str, generator: Generator) -> PaintingPair:
    """The pair with a styled target and the prompt that asks for it; whole images only.

    Raises:
        ConfigError: there is no such style.
    """
    conditions = replace(pair.conditions, prompt=prompt)
    if prompt == DEFAULT_PROMPT:
        return replace(pair, conditions=conditions)
    target = apply_style(target_view(pair), prompt, generator)
    return replace(pair, conditions=conditions, target_rgb=target)


def target_view(pair: PaintingPair) -> StyleView:
    """The target with the depth and the sky of its view."""
    old = pair.conditions
    return StyleView(
        rgb=pair.target_rgb,
        depth_m=torch.where(old.lidar_hit, old.lidar_depth_m, old.render_depth_m),
        sky=_sky(old),
    )


def _sky(conditions: PaintingConditions) -> Float[Tensor, "height width"]:
    """What the Gaussians leave open, above the topmost LiDAR hit of its column.

    Below it, what is open is a hole of the render.
    """
    below_a_hit = conditions.lidar_hit.int().cumsum(dim=0) > 0
    return torch.where(below_a_hit, 0.0, 1 - conditions.render_alpha.clamp(0, 1))
