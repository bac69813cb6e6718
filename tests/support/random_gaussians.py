"""Gaussians that are nothing in particular, and a small scene of them that moves."""

from dataclasses import replace

import torch
from gaussian_world import FRAME_NS, camera_at, car_track, scene_of

from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet


def random_gaussians(count: int, sh_degree: int, seed: int = 0) -> GaussianSet:
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random)

    return GaussianSet(
        means=normal(count, 3) * 20,
        rotation_wxyz=torch.nn.functional.normalize(normal(count, 4), dim=1),
        log_scale=normal(count, 3) - 2,
        opacity_logit=normal(count),
        sh_dc=normal(count, 1, 3),
        sh_rest=normal(count, (sh_degree + 1) ** 2 - 1, 3) * 0.1,
        body_index=torch.zeros(count, dtype=torch.int32),
    )


def moving_scene(num_frames: int = 5, sh_degree: int = 2):
    """A street, a car that drives to the left, and one that comes later; seen at every frame."""
    street = random_gaussians(150, sh_degree, seed=1)
    street = replace(street, means=street.means * torch.tensor([0.1, 0.2, 0.1]) + 9)
    street = replace(street, means=street.means - torch.tensor([0.0, 9.0, 8.0]))
    parts = [street]
    for body in (1, 2):
        car = random_gaussians(40, sh_degree, seed=1 + body)
        bodies = torch.full((40,), body, dtype=torch.int32)
        parts.append(replace(car, means=car.means * 0.02, body_index=bodies))
    first = car_track(num_frames)
    later = slice(num_frames // 2, None)
    second = replace(
        first,
        actor_id='van "7"/é\n',
        category="Van",
        frame_indices=first.frame_indices[later],
        timestamps_ns=first.timestamps_ns[later],
        world_from_box=first.world_from_box[later].flip(0),
        num_points=first.num_points[later],
    )
    cameras = [camera_at(0.1 * frame) for frame in range(num_frames)]
    gaussians = parts[0].append(parts[1]).append(parts[2])
    times_ns = [frame * FRAME_NS for frame in range(num_frames)]
    return scene_of(gaussians, cameras, (first, second)), cameras, times_ns
