"""What memory a fit takes, told before it begins, and how many Gaussians fit into a limit.

Bytes of what is kept are counted; those of a step are what its parts were seen to take, rounded up.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.kernels.sky_texture import SkyLayout
from lidarpainter_models.kernels.sparse_adam.state import VECTOR
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.observations.views import GuidanceView, SceneObservations

FLOAT = 4
"""Bytes of a number."""
IMAGE_BYTES, GUIDANCE_BYTES = 8, 6
"""Of a pixel: colour, depth and kind of a recorded image; colour, weight and depth of a painted."""
PROGRAM_BYTES = 700_000_000
"""Of the process before it holds anything: the interpreter, torch, numba's kernels, arrow."""
HALF_IMAGES = 0.25
"""Of a full image's pixels."""
TEXEL_BYTES = 44
"""Of the sky: colour, weight, moments and visits."""
STEP_FLOATS_PER_PIXEL = 60
"""Of images, terms and their gradients that live at once, most of them SSIM's."""
STEP_FLOATS_PER_TEXEL = 16
"""Gradients of the sky, and what its Adam works with."""
RASTER_BYTES_PER_GAUSSIAN = 512
"""Projected Gaussians, their gradients, and entries of about eight tiles each, sorted."""
LEAST_SHARE = 10
"""A limit that leaves less than one in so many of the Gaussians wanted is refused."""
ROW_BYTES = 68
"""Of a Gaussian: its body, block, place among blocks, tallies, last step, number and its place."""
HIDDEN_BYTES = 1.0
"""Of a Gaussian and a view: the numbers of those that the view leaves out."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitMemory:
    """Bytes on the device of a fit at its largest."""

    gaussians: int
    """Parameters, the optimiser's moments, and what each view leaves out."""
    sky: int
    images: int
    """Recorded and painted, where they are kept there."""
    step: int
    """One step: leaves, gradients, images under way."""
    rasteriser: int
    observed: int
    """What was recorded, on the host: images as bytes, depths, the LiDAR map."""

    @property
    def total(self) -> int:
        """All of it on the device."""
        return self.gaussians + self.sky + self.images + self.step + self.rasteriser

    @property
    def of_process(self) -> int:
        """Of the whole process where the device is the CPU."""
        return self.total + self.observed + PROGRAM_BYTES

    def told(self) -> str:
        """In words, such as `2.1 GB (Gaussians 0.9, images 0.5, ...)`."""
        parts = ("gaussians", "sky", "images", "step", "rasteriser")
        shares = ", ".join(f"{name} {getattr(self, name) / 1e9:.2f}" for name in parts)
        return f"{self.total / 1e9:.2f} GB ({shares})"


def planned_memory(
    observations: SceneObservations,
    config: FitConfig,
    sky: SkyLayout,
    *,
    start: GaussianSet | None = None,
    guidance: Sequence[GuidanceView] = (),
    keeps_images: bool = True,
) -> FitMemory:
    """What a fit takes when it has as many Gaussians as it may have and all are in view.

    Gaussians of the `start` may be more than the budget; `keeps_images` says whether images lie on
    the device, or are sent there one by one.
    """
    at_first = config.initialisation.num_gaussians if start is None else len(start)
    degree = config.initialisation.sh_degree if start is None else start.sh_degree
    count = max(at_first, config.densification.budget)
    columns = 11 + 3 * (degree + 1) ** 2
    padded = columns + -columns % VECTOR
    pixels = [view.camera.width_px * view.camera.height_px for view in observations.views]
    painted = [view.camera.width_px * view.camera.height_px for view in guidance]
    kept = sum(pixels) * (1 + HALF_IMAGES * bool(config.half_resolution)) * IMAGE_BYTES
    texels = sky.rows * sky.columns
    row_bytes = ROW_BYTES + HIDDEN_BYTES * (len(pixels) + len(painted))
    views_at_once = 2 if painted else 1  # on a CPU
    return FitMemory(
        gaussians=round(count * (FLOAT * (columns + 2 * padded) + row_bytes)),
        sky=texels * TEXEL_BYTES,
        images=round(kept + sum(painted) * GUIDANCE_BYTES) if keeps_images else 0,
        step=FLOAT
        * (
            count * ((2 + views_at_once) * columns + 4 * padded)
            + (max(pixels) + max(painted, default=0)) * STEP_FLOATS_PER_PIXEL
            + texels * STEP_FLOATS_PER_TEXEL
        ),
        rasteriser=views_at_once * count * RASTER_BYTES_PER_GAUSSIAN,
        observed=_observed_bytes(observations),
    )


def within_limit(
    observations: SceneObservations,
    config: FitConfig,
    sky: SkyLayout,
    *,
    start: GaussianSet | None = None,
    guidance: Sequence[GuidanceView] = (),
) -> FitConfig:
    """The config with at most as many Gaussians as its `memory_bytes` have room for on a CPU.

    Raises:
        ConfigError: not even a tenth of them fits, or the start does not.
    """
    if config.memory_bytes is None:
        return config

    def taken(count: int) -> int:
        part = _with_at_most(count, config)
        return planned_memory(observations, part, sky, start=start, guidance=guidance).of_process

    at_first = config.initialisation.num_gaussians if start is None else len(start)
    wanted = max(config.densification.budget, at_first)
    if taken(wanted) <= config.memory_bytes:
        return config
    least = max(wanted // LEAST_SHARE, 1 if start is None else at_first)
    room = config.memory_bytes - taken(least)
    if room < 0:
        raise ConfigError(
            f"memory {config.memory_bytes / 1e9:.1f} GB: this fit takes at least "
            f"{taken(least) / 1e9:.1f} GB; fewer cameras, frames or pixels "
            "(observation.width_px) take less"
        )
    each = (taken(wanted) - taken(least)) / (wanted - least)  # equal ones were refused above
    return _with_at_most(least + int(room / each), config)


def _with_at_most(count: int, config: FitConfig) -> FitConfig:
    """The config with at most so many Gaussians, at first and later."""
    growth, first = config.densification, config.initialisation
    return replace(
        config,
        densification=replace(growth, budget=min(growth.budget, count)),
        initialisation=replace(first, num_gaussians=min(first.num_gaussians, count)),
    )


def _observed_bytes(observations: SceneObservations) -> int:
    bodies = (observations.lidar_map.street, *observations.lidar_map.actors.values())
    columns = [getattr(body, field.name) for body in bodies for field in fields(MapPoints)]
    images: list[Tensor] = [
        image
        for view in observations.views
        for image in (view.rgb_u8, view.sky_mask, view.lidar_depth_m)
    ]
    return sum(value.nbytes for value in (*columns, *images))
