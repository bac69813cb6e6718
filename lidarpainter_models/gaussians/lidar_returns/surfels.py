"""The surfaces that sweeps have met, as flat Gaussians: the street, and each actor in its box.

A fit to images leaves surfaces a few centimetres thick and lets the far ones float; a LiDAR says
within two centimetres where they are. So rays meet surfels of the LiDAR map, which stand for no
image, and the fitted scene's own Gaussians only where nobody swept: of inserted actors.
"""

from collections.abc import Collection

import torch

from lidarpainter_models.gaussians.initialisation.adaptive_voxels import Cloud, adaptive_voxels
from lidarpainter_models.gaussians.initialisation.surfels import surfels_from_points
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.placing import joined_gaussians
from lidarpainter_models.lidar.map_building import gather_points
from lidarpainter_models.scenes.driving_scene import DrivingScene

SPACING = 0.004
"""Spacing that is asked for, in units of the range: about that of the beams of a dense sensor."""
LEAST_VOXEL_M = 0.05
REACH = 0.5
"""Largest standard deviation within the surface, in voxels."""
THICKNESS = 0.05
"""Standard deviation across the surface, in units of that within it, at least."""


def surfels_of(
    scene: DrivingScene, frames: Collection[int], *, most: int
) -> tuple[GaussianSet, tuple[str, ...]]:
    """Surfels of what the sweeps of some frames met.

    Args:
        scene: the log, its poses corrected.
        frames: whose sweeps are read; no other is.
        most: how many surfels there may be.

    Returns:
        The surfels, and the ids of the actors that bodies 1, 2, ... are.
    """
    points = gather_points(scene, frames)
    parts = [points.street, *points.actors.values()]
    clouds = [
        Cloud.of(
            part, SPACING * part.range_m, torch.ones(len(part), dtype=torch.bool), LEAST_VOXEL_M
        )
        for part in parts
    ]
    sets = []
    for body, voxels in enumerate(adaptive_voxels(clouds, budget=most)):
        made = surfels_from_points(
            voxels.xyz_m,
            torch.full_like(voxels.xyz_m, 0.5),
            body=body,
            sh_degree=0,
            most_sigma_m=REACH * voxels.size_m,
            least_thickness=THICKNESS,
        )
        sets.append(made)
    return joined_gaussians(sets), tuple(points.actors)
