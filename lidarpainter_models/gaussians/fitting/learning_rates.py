"""Learning rates of a fit: step sizes by kind of parameter, and how they fall; without tensors.

`gaussian_adam` and `refinement` are the optimisers that take these steps.
"""

from dataclasses import dataclass, replace

COLOUR_LOOKS = 300.0
"""Colours move no further in a longer fit than in one of so many looks. Those that recorded views
hardly show move as fast as Adam lets them, and what they end up as stands in full view of the next
lane: the longer the fit, the further off (docs/decisions/rates-of-learning.md)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningRates:
    """The first and the last step size of every kind; each falls exponentially in between."""

    means: tuple[float, float] = (0.03, 0.002)
    """Centres, in standard deviations of the Gaussian (mean of its two longer axes)."""
    rotation_wxyz: tuple[float, float] = (8e-3, 1.6e-3)
    """Orientations, in units of the quaternion."""
    log_scale: tuple[float, float] = (4e-2, 8e-3)
    """Sizes, in logarithms of metres. Shapes are what a fit waits for: at a quarter of these rates
    it takes nearly twice the steps (docs/decisions/rates-of-learning.md)."""
    opacity_logit: tuple[float, float] = (6e-2, 2e-2)
    """Opacities, in logits."""
    sh_dc: tuple[float, float] = (6e-3, 1e-3)
    """Constant harmonics; a colour changes by 0.28 of it. In fits of more than `COLOUR_LOOKS` less.
    Twice as fast, recorded views gain 0.07 dB and the next lane's lose 0.3
    (docs/decisions/rates-of-learning.md)."""
    sh_rest: tuple[float, float] = (6e-4, 2e-4)
    """Harmonics of degree 1 and more."""
    camera_rotation_rad: tuple[float, float] = (6e-4, 6e-5)
    """Camera angles; a pixel of a 480-pixel image is about 2e-3 rad."""
    camera_translation_m: tuple[float, float] = (6e-3, 6e-4)
    """Camera positions, recorded to centimetres."""
    actor_rotation_rad: tuple[float, float] = (2e-3, 2e-4)
    """Actors' angles; boxes are drawn by hand, and a degree off is common."""
    actor_translation_m: tuple[float, float] = (1e-2, 1e-3)
    """Actors' positions; a decimetre off is common."""
    actor_light: tuple[float, float] = (2e-2, 4e-3)
    """Logarithms of actors' gains: from sun to shade a car loses half of its light."""
    bending_m: tuple[float, float] = (1e-2, 1e-3)
    """Nodes of the lattice that bends somebody who walks."""
    exposure: tuple[float, float] = (6e-3, 6e-4)
    """Entries of a camera's colour matrix."""

    def at(self, name: str, fraction: float) -> float:
        """Return the rate of the named field after a fraction, 0 to 1, of the fit."""
        first, last = getattr(self, name)
        return first * (last / first) ** min(max(fraction, 0.0), 1.0)

    def over(self, looks: float) -> "LearningRates":
        """Return the rates of a fit of so many looks at every view's worth of new surface."""
        share = min(COLOUR_LOOKS / looks, 1.0)
        first, last = self.sh_dc
        return replace(self, sh_dc=(first * share, last * share))
