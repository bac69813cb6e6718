"""How many Gaussians a fit starts with, and where; read without tensors."""

from dataclasses import dataclass

from lidarpainter_models.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialisationConfig:
    """How many Gaussians a fit starts with, and where."""

    num_gaussians: int = 0
    """Start size, which densification brings to the budget; 0 follows the budget."""
    sh_degree: int = 1
    """One degree: few views see a surface from far-apart directions."""
    street_voxel_m: float = 0.03
    """Smallest voxel on the street."""

    def __post_init__(self) -> None:
        """Refuse a negative start."""
        if self.num_gaussians < 0:
            raise ConfigError(f"num_gaussians must not be negative, got {self.num_gaussians}")
