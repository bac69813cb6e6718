"""What the parts of a fit can be told, each setting with its reason; read without tensors."""

from dataclasses import dataclass, replace

from lidarpainter_models.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class DensificationConfig:
    """When and how far the number of Gaussians changes."""

    budget: int = 0
    """Never more Gaussians than this; 0 follows the effort of the fit."""
    start: float = 0.1
    """Fraction of the fit after which splitting begins: gradients must mean something."""
    stop: float = 0.6
    """Fraction of the fit after which it ends: new Gaussians need time to settle."""
    every: int = 50
    """Steps between two rounds; several passes over the views of a short log."""
    threshold: float = 0.0
    """Splits what has a larger mean gradient than this, up to the budget, as plain 3DGS does: 4e-6
    for each pixel at 480x270 is the 8e-4 of Ye et al. in units of half an image. 0 fills the budget
    in even rounds, whatever the gradients."""

    def __post_init__(self) -> None:
        """Refuse a schedule that runs backwards."""
        if not 0 <= self.start <= self.stop <= 1 or self.every < 1:
            raise ConfigError(
                f"densification needs 0 <= start <= stop <= 1 and every >= 1, got start "
                f"{self.start}, stop {self.stop}, every {self.every}"
            )
        if min(self.budget, self.threshold) < 0:
            raise ConfigError(
                f"densification.budget and threshold must not be negative, got {self.budget} and "
                f"{self.threshold}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class FitLossWeights:
    """How much each part of the loss counts."""

    ssim: float = 0.2
    """Of 1 - SSIM beside the mean absolute difference."""
    perceptual: float = 0.0
    """Of the perceptual distance, where one is given to the fit."""
    sky: float = 0.05
    """Of the clear-sky term, on painted views of its part where LiDAR hit something."""
    sky_tolerance: float = 0.06
    """A pixel without LiDAR return this close to the sky's colour counts as sky: between wires
    the fit would otherwise hang sky-coloured needles at any depth."""
    actors: float = 0.1
    """Of the term that keeps actors inside their boxes."""
    depth: float = 0.05
    """Of the LiDAR depth term."""
    depth_tolerance: float = 0.05
    """Relative depth error from which on the pull of the LiDAR weakens."""


COLOUR_LOOKS = 300.0
"""Colours move no further in a longer fit than in one of so many looks. Those that recorded views
hardly show move as fast as Adam lets them, and what they end up as stands in full view of the next
lane: the longer the fit, the further off (docs/decisions/rates-of-learning.md)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningRates:
    """First and last step sizes; each falls exponentially from the one to the other."""

    means: tuple[float, float] = (0.03, 0.002)
    """In standard deviations of the Gaussian (mean of its two longer axes)."""
    rotation_wxyz: tuple[float, float] = (8e-3, 1.6e-3)
    """Quaternion units."""
    log_scale: tuple[float, float] = (4e-2, 8e-3)
    """Logarithm of metres. Shapes are what a fit waits for: at a quarter of these rates it takes
    nearly twice the steps (docs/decisions/rates-of-learning.md)."""
    opacity_logit: tuple[float, float] = (6e-2, 2e-2)
    """Logits."""
    sh_dc: tuple[float, float] = (6e-3, 1e-3)
    """Harmonics; a colour changes by 0.28 of it. In fits of more than `COLOUR_LOOKS` less. Twice as
    fast, recorded views gain 0.07 dB and the next lane's lose 0.3
    (docs/decisions/rates-of-learning.md)."""
    sh_rest: tuple[float, float] = (6e-4, 2e-4)
    """Harmonics of degree 1 and more."""
    camera_rotation_rad: tuple[float, float] = (6e-4, 6e-5)
    """A pixel of a 480-pixel image is about 2e-3 rad."""
    camera_translation_m: tuple[float, float] = (6e-3, 6e-4)
    """Recorded positions are good to centimetres."""
    actor_rotation_rad: tuple[float, float] = (2e-3, 2e-4)
    """Boxes are drawn by hand: a degree off is common."""
    actor_translation_m: tuple[float, float] = (1e-2, 1e-3)
    """Boxes are drawn by hand: a decimetre off is common."""
    bending_m: tuple[float, float] = (1e-2, 1e-3)
    """Of the lattice of somebody who walks."""
    exposure: tuple[float, float] = (6e-3, 6e-4)
    """Entries of a camera's colour matrix."""

    def at(self, name: str, fraction: float) -> float:
        """The rate of one kind after a fraction of the fit."""
        first, last = getattr(self, name)
        return first * (last / first) ** min(max(fraction, 0.0), 1.0)

    def over(self, looks: float) -> "LearningRates":
        """The rates of a fit of so many looks at every view's worth of new surface."""
        share = min(COLOUR_LOOKS / looks, 1.0)
        first, last = self.sh_dc
        return replace(self, sh_dc=(first * share, last * share))


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeLimits:
    """Which shapes a Gaussian may take."""

    most_elongation: float = 12.0
    """Longest over middle axis: poles and wires need needles."""
    most_elongation_along_ray: float = 2.0
    """The same for an axis within 45 degrees of the viewing ray."""
    most_sigma: float = 0.1
    """Longest axis in units of the distance to the nearest camera."""
