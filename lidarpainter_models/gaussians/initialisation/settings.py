"""How many Gaussians a fit starts with, and where; read without tensors."""

from dataclasses import dataclass

from lidarpainter_models.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialisationConfig:
    """How many Gaussians a fit starts with, and where."""

    num_gaussians: int = 55_000
    """Start size; densification brings it to the budget of the fit."""
    aside_m: float = 3.5
    """How far aside such a camera may stand."""
    sh_degree: int = 1
    """One degree: few views see a surface from far-apart directions."""
    street_voxel_m: float = 0.03
    """Smallest voxel on the street."""

    def __post_init__(self) -> None:
        """Refuse a start without Gaussians."""
        if self.num_gaussians < 1:
            raise ConfigError(f"num_gaussians must be positive, got {self.num_gaussians}")
