"""How the LiDAR of a scene is learnt."""

from dataclasses import dataclass

from lidarpainter_models.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarConfig:
    """How surfels and what they send back are found from a log's training sweeps."""

    num_surfels: int = 150_000
    """At most so many surfels make up the surfaces."""
    steps: int = 400
    """Optimiser steps."""
    rays_per_step: int = 16_384
    """Rays that a step looks at."""
    rays_per_sweep: int = 30_000
    """Of each training sweep so many rays are learnt from."""
    most_rays: int = 600_000
    """Rays of all training sweeps together: longer logs give fewer of each."""
    hits: int = 28
    """Surfels along a ray that are learnt from; the ray goes through the rest unchanged."""
    seed: int = 0
    """Of the choice of rays."""

    def __post_init__(self) -> None:
        """Refuse what learns nothing."""
        for name in ("num_surfels", "steps", "rays_per_step", "rays_per_sweep", "most_rays"):
            if getattr(self, name) < 1:
                raise ConfigError(f"lidar.{name} {getattr(self, name)}, expected at least 1")
        if not 4 <= self.hits <= 128:
            raise ConfigError(f"lidar.hits {self.hits}, expected 4 to 128")
