"""Memory that a fit takes, told before it begins, and how many Gaussians fit into a limit.

Bytes of what is kept are counted; those of a step are what its parts were seen to take, rounded up.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.kernels.sky_texture import SkyLayout
from lidarpainter_models.kernels.sparse_adam import VECTOR
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.observations.views import GuidanceView, SceneObservations

FLOAT = 4
"""Bytes of a number."""
IMAGE_BYTES, GUIDANCE_BYTES = 8, 6
"""Bytes of a pixel: colour, depth and kind of a recorded image; colour, weight and depth of a
painted one."""
PROGRAM_BYTES = 700_000_000
"""Bytes of the process before it holds anything: the interpreter, torch, numba's kernels, arrow."""
HALF_IMAGES = 0.25
"""Part of a full image's pixels that a half-size one has."""
TEXEL_BYTES = 44
"""Bytes of a texel of the sky: colour, weight, moments and visits."""
STEP_FLOATS_PER_PIXEL = 60
"""Numbers of images, terms and their gradients that live at once, most of them SSIM's."""
STEP_FLOATS_PER_TEXEL = 16
"""Gradients of the sky, and what its Adam works with."""
RASTER_BYTES_PER_GAUSSIAN = 512
"""Projected Gaussians, their gradients, and entries of about eight tiles each, sorted."""
LEAST_SHARE = 10
"""A limit that leaves less than one in so many of the Gaussians wanted is refused."""
ROW_BYTES = 68
"""Bytes of a Gaussian: body, block, place among blocks, tallies, last step, number, its place."""
HIDDEN_BYTES = 1.0
"""Bytes of a Gaussian and a view: the numbers of those that the view leaves out."""


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
        """Bytes of everything on the device."""
        return self.gaussians + self.sky + self.images + self.step + self.rasteriser

    @property
    def of_process(self) -> int:
        """Bytes of the whole process where the device is the CPU."""
        return self.total + self.observed + PROGRAM_BYTES


def planned_memory(
    observations: SceneObservations,
    config: FitConfig,
    sky: SkyLayout,
    *,
    start: GaussianSet | None = None,
    guidance: Sequence[GuidanceView] = (),
    most_gaussians: int | None = None,
    keeps_images: bool = True,
) -> FitMemory:
    """Return what a fit takes when it has as many Gaussians as it may have and all are in view.

    A `start` may have more than the budget of the planned settings. There may be `most_gaussians`,
    at first and later; images lie on the device, or are sent there one by one.
    """
    most = math.inf if most_gaussians is None else most_gaussians
    first = min(config.initialisation.num_gaussians, most)
    at_first = first if start is None else len(start)
    degree = config.initialisation.sh_degree if start is None else start.sh_degree
    count = int(max(at_first, min(config.densification.budget, most)))
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


def gaussians_within_limit(
    observations: SceneObservations,
    config: FitConfig,
    sky: SkyLayout,
    *,
    start: GaussianSet | None = None,
    guidance: Sequence[GuidanceView] = (),
) -> int:
    """Return how many Gaussians the `memory_bytes` of planned settings have room for on a CPU.

    Raises:
        ConfigError: not even a tenth of those planned fits, or the start does not.
    """

    def taken(count: int) -> int:
        memory = planned_memory(
            observations, config, sky, most_gaussians=count, start=start, guidance=guidance
        )
        return memory.of_process

    limit = config.memory_bytes or math.inf
    at_first = config.initialisation.num_gaussians if start is None else len(start)
    wanted = max(config.densification.budget, at_first)
    if taken(wanted) <= limit:
        return wanted
    least = max(wanted // LEAST_SHARE, 1 if start is None else at_first)
    room = limit - taken(least)
    if room < 0:
        raise ConfigError(
            f"memory {limit / 1e9:.1f} GB: this fit takes at least {taken(least) / 1e9:.1f} GB; "
            "fewer cameras, frames or pixels (observation.width_px) take less"
        )
    each = (taken(wanted) - taken(least)) / (wanted - least)  # equal ones were refused above
    return least + int(room / each)


def _observed_bytes(observations: SceneObservations) -> int:
    bodies = (observations.lidar_map.street, *observations.lidar_map.actors.values())
    columns = [getattr(body, field.name) for body in bodies for field in fields(MapPoints)]
    images: list[Tensor] = [
        image
        for view in observations.views
        for image in (view.rgb_u8, view.sky_mask, view.lidar_depth_m)
    ]
    return sum(value.nbytes for value in (*columns, *images))
