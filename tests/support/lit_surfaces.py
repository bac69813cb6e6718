"""Surfaces, lamps and air of seeded numbers, to be lit by `scene_light`."""

import torch

from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.kernels.scene_light import (
    Appearance,
    Lamps,
    Surfaces,
    Surroundings,
    body_radii,
)

BODIES = 4


def random_scene(count, lamps=7, seed=0):
    """Surfaces, how they look, their surroundings, lamps, and where the bodies stand."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*size):
        return torch.rand(*size, generator=generator)

    unit = torch.nn.functional.normalize
    means = 30 * (rand(count, 3) - 0.5)
    body = torch.randint(0, BODIES, (count,), generator=generator).int()
    surfaces = Surfaces(
        means=means,
        body_index=body,
        reach_m=rand(count),
        normals=unit(rand(count, 3) - 0.5, dim=1) * rand(count, 1),
        facing=rand(count),
        least_facing=0.1 * rand(count),
        body_radius_m=body_radii(means, body),
    )
    appearance = Appearance(
        light=rand(count, 3),
        reflectance=rand(count, 3),
        harmonics=rand(count, 3, 3) - 0.5,
        per_base=1 + rand(count, 3),
        shine=rand(count) * (rand(count) < 0.5),
        skyline=torch.randint(-1, 3, (count,), generator=generator).int(),
    )
    around = Surroundings(
        extinction_per_m=0.02, airlight=rand(3), sky_light=rand(3), skylines=rand(3, 8, 4)
    )
    heading = unit((rand(lamps, 3) - 0.5) * torch.tensor([1.0, 1.0, 0.0]), dim=1)
    heading[::2] = 0
    shining = Lamps(
        position_world=20 * (rand(lamps, 3) - 0.5),
        heading_world=heading,
        power_rgb=10 * rand(lamps, 3),
        reach_m=5 + 20 * rand(lamps),
        is_fixed=rand(lamps) < 0.5,
    )
    poses = rigid_from_tangent(torch.randn(BODIES, 6, generator=generator).double())
    poses[0] = torch.eye(4)
    return surfaces, appearance, around, shining, poses
