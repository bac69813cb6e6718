"""Draw a scene that a test keeps as one dictionary: the fields of `Splats`, a camera, options."""

from dataclasses import fields, replace

import pytest
import torch

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.backends import why_missing
from lidarpainter_models.kernels.gaussian_raster import Splats, render_gaussians

SPLATS = tuple(field.name for field in fields(Splats))
WITHOUT_TRITON = why_missing("gaussian_raster", "triton")
TRITON = pytest.param(
    "triton",
    marks=[
        pytest.mark.skipif(WITHOUT_TRITON is not None, reason=str(WITHOUT_TRITON)),
        # numpy interprets, and says of infinite numbers what a GPU does not
        pytest.mark.filterwarnings("ignore:.* encountered in:RuntimeWarning"),
    ],
)
"""The backend of this name on a GPU, or else in Triton's interpreter."""


def pinhole(**lens):
    """A camera of this lens; the rasteriser does not ask where it stands."""
    return Camera(world_from_camera=torch.eye(4, dtype=torch.float64), **lens)


def split(scene):
    """The Gaussians of a scene, and the rest of it by name."""
    rest = {name: value for name, value in scene.items() if name not in SPLATS}
    return Splats(**{name: scene[name] for name in SPLATS}), rest


def home_of(backend):
    """The device that a backend draws on."""
    on_gpu = backend in ("cuda", "triton") and torch.cuda.is_available()
    return torch.device("cuda" if on_gpu else "cpu")


def render(scene, *, backend="auto", **options):
    """`render_gaussians` of a scene on the backend's device; the images come back."""
    device = home_of(backend)
    if device.type == "cpu":
        splats, rest = split(scene)
        return render_gaussians(splats, **rest, backend=backend, **options)
    moved = {k: v.to(device) if torch.is_tensor(v) else v for k, v in scene.items()}
    splats, rest = split(moved)
    image = render_gaussians(splats, **rest, backend=backend, **options)
    return replace(
        image, **{field.name: getattr(image, field.name).cpu() for field in fields(image)}
    )
