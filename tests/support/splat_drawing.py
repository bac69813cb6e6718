"""Draw a scene that a test keeps as one dictionary: the fields of `Splats`, a camera, options."""

from dataclasses import fields

import torch

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.gaussian_raster import Splats, render_gaussians

SPLATS = tuple(field.name for field in fields(Splats))


def pinhole(**lens):
    """A camera of this lens; the rasteriser does not ask where it stands."""
    return Camera(world_from_camera=torch.eye(4, dtype=torch.float64), **lens)


def split(scene):
    """The Gaussians of a scene, and the rest of it by name."""
    rest = {name: value for name, value in scene.items() if name not in SPLATS}
    return Splats(**{name: scene[name] for name in SPLATS}), rest


def render(scene, **options):
    """`render_gaussians` of a scene."""
    splats, rest = split(scene)
    return render_gaussians(splats, **rest, **options)
