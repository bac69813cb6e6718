"""Weather and time of day for an image whose depth is known, without another learned model."""

from dataclasses import replace

from jaxtyping import Float
from torch import Generator, Tensor

from lidarpainter_models.painter.styles.fog import add_fog
from lidarpainter_models.painter.styles.night import turn_to_night
from lidarpainter_models.painter.styles.rain import add_rain
from lidarpainter_models.painter.styles.view import StyleView
from lidarpainter_models.weather.mix import FOG_VISIBILITY_M, STYLE_PROMPTS, StyleMix, check_prompt

__all__ = ["STYLE_PROMPTS", "StyleView", "apply_mix", "apply_style", "check_prompt"]


def apply_style(
    view: StyleView,
    prompt: str,
    generator: Generator,
    *,
    strength: float = 1.0,
    visibility_m: float = FOG_VISIBILITY_M,
    place_seed: int = 0,
) -> Float[Tensor, "height width 3"]:
    """The view in a style, as displayed; the same for the same state of the generator.

    `place_seed` decides what stays where it is from view to view: puddles.

    Raises:
        ConfigError: there is no such style.
    """
    check_prompt(prompt)
    if prompt == "foggy":
        return add_fog(view, visibility_m / strength)
    if prompt == "night":
        return turn_to_night(view, generator, strength)
    if prompt == "rain":
        return add_rain(view, generator, strength, place_seed=place_seed)
    return view.rgb


def apply_mix(
    view: StyleView, mix: StyleMix, generator: Generator, *, progress: float, place_seed: int = 0
) -> Float[Tensor, "height width 3"]:
    """The view under all styles of a mix: first it gets wet, then dark, then fog comes up.

    `progress` is the share of the log's time that has passed, which strengths may follow.
    `place_seed` is that of `apply_style`.
    """
    strengths = mix.strengths(progress)
    for prompt in ("rain", "night", "foggy"):
        if prompt in strengths:
            rgb = apply_style(
                view,
                prompt,
                generator,
                strength=strengths[prompt],
                visibility_m=mix.visibility_m,
                place_seed=place_seed,
            )
            view = replace(view, rgb=rgb)
    return view.rgb
