"""Weather and time of day for an image whose depth is known, without another learned model."""

from jaxtyping import Float
from torch import Generator, Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT
from lidarpainter_models.painter.styles.fog import add_fog
from lidarpainter_models.painter.styles.night import turn_to_night
from lidarpainter_models.painter.styles.rain import add_rain
from lidarpainter_models.painter.styles.view import StyleView

__all__ = ["STYLE_PROMPTS", "StyleView", "apply_style", "check_prompt"]

STYLE_PROMPTS = (DEFAULT_PROMPT, "foggy", "night", "rain")
"""Prompts that a style stands behind; the first changes nothing."""


def check_prompt(prompt: str) -> str:
    """The prompt, if a style stands behind it.

    Raises:
        ConfigError: none does.
    """
    if prompt not in STYLE_PROMPTS:
        raise ConfigError(f"no style {prompt!r}, expected {', '.join(STYLE_PROMPTS)}")
    return prompt


def apply_style(
    view: StyleView, prompt: str, generator: Generator
) -> Float[Tensor, "height width 3"]:
    """The view in a style, as displayed; the same for the same state of the generator.

    Raises:
        ConfigError: there is no such style.
    """
    check_prompt(prompt)
    if prompt == "foggy":
        return add_fog(view)
    if prompt == "night":
        return turn_to_night(view, generator)
    if prompt == "rain":
        return add_rain(view, generator)
    return view.rgb
