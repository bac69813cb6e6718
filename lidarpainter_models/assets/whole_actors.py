"""Actors as they are published: vehicles whole, others without what is none of theirs.

Box frame: x along the length, y left, z up, origin at the centre; metres.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.assets.completion import WholeActor, completed
from lidarpainter_models.assets.seen_surfaces import SeenSurface
from lidarpainter_models.editing.actor_models import ActorModel
from lidarpainter_models.editing.worlds import EditedWorld
from lidarpainter_models.errors import SceneError
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.geometry.transforms import rotation_from_quaternion
from lidarpainter_models.lidar.vehicle_colours import SEEN
from lidarpainter_models.lidar.vehicle_shapes import has_known_shape

LEAST_GAUSSIANS = 20
"""An actor of fewer is a smear."""
LEAST_SEEN = 0.02
"""Share of a surface that must have been seen: of less the colours are unknown."""
BEYOND = 1.1
"""No Gaussian reaches farther than so many half sizes of the box."""
LEAST_SHRUNK = 0.05
"""Gaussians that would have to shrink by more are left out."""
SIGMAS = 2.0
"""Where a Gaussian ends that is seen against a bright background: at a tenth of its middle."""


def surfaces_of(world: EditedWorld) -> dict[str, SeenSurface]:
    """The surfaces of the vehicles of a scene, by id, before images tell their colours."""
    found = {}
    for track in world.tracks:
        if not has_known_shape(track):
            continue
        try:
            model = world.model_of(track)
        except SceneError:
            continue  # nothing of it was fitted
        if len(model.gaussians) >= LEAST_GAUSSIANS:
            found[track.actor_id] = SeenSurface.of(model)
    return found


def whole_actor(model: ActorModel, surface: SeenSurface | None) -> WholeActor:
    """A vehicle whole if enough of its surface was seen; of all others what lies in their box."""
    if surface is not None and surface.seen_share >= LEAST_SEEN:
        return completed(model, surface)
    kept = kept_in_box(model.gaussians, model.size_m)
    origin = torch.full((len(kept),), SEEN)
    return WholeActor(model=replace(model, gaussians=kept), origin=origin)


def kept_in_box(gaussians: GaussianSet, size_m: Float[Tensor, "3"]) -> GaussianSet:
    """Gaussians whose middle is inside `BEYOND` of a box, none reaching beyond that.

    Whoever reaches farther is shrunk along all of its axes alike: a spike that only training views
    showed from its end becomes what they showed.
    """
    room_m = BEYOND * size_m / 2
    inside = (gaussians.means.abs() < room_m).all(dim=1)
    own = gaussians.select(inside.nonzero()[:, 0])
    axes = rotation_from_quaternion(own.rotation_wxyz) * own.scale_m[:, None]
    reach_m = SIGMAS * axes.norm(dim=2)
    factor = ((room_m - own.means.abs()) / reach_m).amin(1).clamp(max=1.0)
    kept = (factor >= LEAST_SHRUNK).nonzero()[:, 0]
    own = own.select(kept)
    return replace(own, log_scale=own.log_scale + factor[kept].log()[:, None])
