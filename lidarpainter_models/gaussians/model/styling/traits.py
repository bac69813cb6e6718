"""What Gaussians are as surfaces: which way they face, whether they are road or a lit window."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.styling.ground import find_ground
from lidarpainter_models.gaussians.model.styling.scene_style import StyledPlace
from lidarpainter_models.gaussians.model.styling.skylines import Skylines, find_skylines
from lidarpainter_models.geometry.transforms import rotation_from_quaternion
from lidarpainter_models.kernels.frustum_culling import MOST_SIGMAS
from lidarpainter_models.kernels.scene_light import Surfaces, body_radii
from lidarpainter_models.weather.darkness import FACING, HEADLAMP_HEIGHT_M, LEAST_GRAZING
from lidarpainter_models.weather.light import to_linear

WINDOW_DEPTH_M = 0.6
"""A Gaussian belongs to a window's pane up to this distance before and behind it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceTraits:
    """Facts about the Gaussians of a scene that no style and no time changes."""

    surfaces: Surfaces
    day_light: Float[Tensor, "gaussians 3"]
    """Linear colour on a clear day, without what depends on the direction of view."""
    base_rgb: Float[Tensor, "gaussians 3"]
    ground: Float[Tensor, " gaussians"]
    """How far each is ground, in [0, 1]."""
    window: Float[Tensor, " gaussians"]
    """How far each is a lit window, in [0, 1]."""
    skylines: Skylines


def surface_traits(gaussians: GaussianSet, place: StyledPlace) -> SurfaceTraits:
    """Find them; the street's Gaussians may be ground and windows, those of actors neither."""
    columns = gaussians.columns()
    means, body = columns["means"], columns["body_index"]
    street = (body == 0).float()
    opacity = columns["opacity_logit"].sigmoid()
    road = place.ego_lamp - place.ego_lamp.new_tensor([0.0, 0.0, HEADLAMP_HEIGHT_M])
    ground = find_ground(means, opacity * street, road).share(means) * street
    base_rgb = gaussians.base_rgb.detach()
    day_light = to_linear(base_rgb)
    scale_m = columns["log_scale"].exp()
    up = means.new_tensor([0.0, 0.0, 1.0])
    normals = ground[:, None] * up + (1 - ground)[:, None] * _normals(columns, scale_m)
    facing = FACING + ground * (1 - FACING)
    return SurfaceTraits(
        surfaces=Surfaces(
            means=means,
            body_index=body,
            reach_m=MOST_SIGMAS * scale_m.amax(dim=1),
            normals=normals,
            facing=facing,
            least_facing=facing * LEAST_GRAZING,
            body_radius_m=body_radii(means, body),
        ),
        day_light=day_light,
        base_rgb=base_rgb,
        ground=ground,
        window=_windows(means, place) * street,
        skylines=find_skylines(means, day_light, ground, street * (ground == 0) * (opacity > 0.5)),
    )


def _normals(
    columns: dict[str, Tensor], scale_m: Float[Tensor, "gaussians 3"]
) -> Float[Tensor, "gaussians 3"]:
    """The shortest axis of each Gaussian in its body, shorter the less flat it is."""
    shortest, middle, _ = scale_m.sort(dim=1).values.unbind(1)
    axis = scale_m.argmin(dim=1)
    rotation = rotation_from_quaternion(columns["rotation_wxyz"])
    normals = rotation[torch.arange(len(axis), device=axis.device), :, axis]
    return normals * (1 - shortest / middle.clamp_min(1e-9))[:, None]


def _windows(
    points_world: Float[Tensor, "gaussians 3"], place: StyledPlace
) -> Float[Tensor, " gaussians"]:
    """1 in the pane of a lit window, falling to 0 along its frame; one window at a time."""
    found = torch.zeros_like(points_world[:, 0])
    for centre, along, half_m in zip(
        place.window_centre, place.window_along, place.window_half_m, strict=True
    ):
        offset = points_world - centre
        sideways = offset @ along
        across = offset[:, 0] * along[1] - offset[:, 1] * along[0]
        edge = torch.minimum(half_m[0] - sideways.abs(), half_m[1] - offset[:, 2].abs())
        inside = (edge / 0.1 + 0.5).clamp(0, 1) * (across.abs() < WINDOW_DEPTH_M)
        found = torch.maximum(found, inside)
    return found
