"""Put what somebody else's file holds into our box frame, in metres, as an actor.

Box frame: x along the length, y left, z up, origin at the centre; metres. What stands in it is
taken to be in neutral exposure, as all assets are kept: a mesh is lit so by an even sky.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.assets.foreign_files import ForeignShape
from lidarpainter_models.assets.import_formats import Axis, ImportFormat
from lidarpainter_models.assets.surface_gaussians import surface_gaussians
from lidarpainter_models.editing.actor_models import (
    NEUTRAL_ROAD_RGB,
    OPAQUE,
    ActorModel,
    sampled_points,
)
from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, sh_from_rgb
from lidarpainter_models.gaussians.model.placing import carried_gaussians

LONGEST_M: dict[str, tuple[float, float]] = {
    "car": (2, 8),
    "pickup": (3, 9),
    "van": (3, 12),
    "truck": (3, 30),
    "bus": (4, 30),
    "motorcycle": (1, 4),
    "bicycle": (0.8, 4),
    "pedestrian": (0.5, 2.6),
}
"""Shortest and longest that the longest side may be, by category."""
ANY_LONGEST_M = (0.05, 60.0)
"""The same for every other category."""
FLATTEST = 0.01
"""Every side must have at least this share of the longest one: a flat thing has no volume."""
MOST_UNLIKE = 1.25
"""Once it is scaled to the length of `--size`, width and height may differ by this factor."""
MOST_GAUSSIANS = 1_000_000
"""Limit on the Gaussians of one file: more are a whole scene."""
UPRIGHT = ("pedestrian", "animal")
"""Categories that keep the front of the file, though a longer side lies across it: the shoulders
of a person are wider than the chest is deep."""
BLACKEST = 1e-3
"""Least value of a colour: exact black marks a contact shadow, which an edit takes away."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """What a user says of a file: the category, and what the file itself does not tell."""

    category: str
    size_m: tuple[float, float, float] | None = None
    """Length, width and height; the shape is scaled to this length."""
    up: Axis | None = None
    forward: Axis | None = None
    """The axis that the front looks along; if absent, that of the longest horizontal side."""

    def __post_init__(self) -> None:
        """Refuse a placement that makes no sense.

        Raises:
            ConfigError: the category is empty, or the size is not three positive lengths.
        """
        if not self.category.strip():
            raise ConfigError("--category is empty, expected a word such as car")
        if self.size_m and not all(0 < side < math.inf for side in self.size_m):
            raise ConfigError("--size: expected three lengths in metres, such as 4.5,1.8,1.5")


def placed_actor(
    shape: ForeignShape, row: ImportFormat, said: Placement
) -> tuple[ActorModel, Axis, Axis]:
    """An actor in our box frame, and which axes of the file were taken for up and ahead.

    Raises:
        ConfigError: the front and up lie along the same axis of the file.
        DataError: nothing in it is opaque, or nothing of its category is as large or as small.
    """
    up = said.up or shape.up or row.up
    custom = row.forward if up == row.up else ("x" if up[-1] == "z" else "z")
    forward = said.forward or custom
    if forward[-1] == up[-1]:
        raise ConfigError(f"--forward {forward}: expected another axis than up, {up}")
    points, is_told = _points(shape), shape.size_m is not None
    low, high = _bounds(points @ _turn(up, forward).T, shape)
    is_free = not is_told and said.forward is None and said.category not in UPRIGHT
    if is_free and high[1] - low[1] > high[0] - low[0]:
        forward = next(axis for axis in ("x", "y", "z") if axis not in (up[-1], forward[-1]))
        low, high = _bounds(points @ _turn(up, forward).T, shape)
    size_m, factor = _size(high - low, shape, said)
    box_from_file = torch.eye(4, dtype=torch.float64)
    box_from_file[:3, :3] = _turn(up, forward) * factor
    box_from_file[:3, 3] = -(low + high) / 2 * factor
    gaussians = _gaussians(shape, box_from_file, factor)
    black = sh_from_rgb(torch.full((1, 3), BLACKEST))
    gaussians = replace(gaussians, sh_dc=torch.maximum(gaussians.sh_dc, black))
    model = ActorModel(
        gaussians=gaussians,
        points=sampled_points(gaussians),
        size_m=size_m.float(),
        category=said.category,
        road_rgb=torch.tensor(NEUTRAL_ROAD_RGB),
    )
    return model, up, forward


def _gaussians(
    shape: ForeignShape, box_from_file: Float[Tensor, "4 4"], factor: float
) -> GaussianSet:
    """Gaussians in the box frame, `factor` times as large as in the file."""
    if shape.gaussians is None:
        return surface_gaussians(shape.meshes, box_from_file, is_linear=shape.is_linear)
    rigid = torch.cat([box_from_file[:3] / factor, box_from_file[3:]])
    turned = carried_gaussians(shape.gaussians, rigid)
    return replace(
        turned, means=turned.means * factor, log_scale=turned.log_scale + math.log(factor)
    )


def _turn(up: Axis, forward: Axis) -> Float[Tensor, "3 3"]:
    """Box from file: rows are ahead, left and up in the file's axes."""
    ahead, above = (
        torch.eye(3, dtype=torch.float64)["xyz".index(axis[-1])] * (-1 if "-" in axis else 1)
        for axis in (forward, up)
    )
    return torch.stack([ahead, torch.linalg.cross(above, ahead), above])


def _points(shape: ForeignShape) -> Float[Tensor, "points 3"]:
    """What the box is found around: corners of triangles, or opaque Gaussians."""
    if shape.gaussians is None:
        corners = [torch.from_numpy(mesh.triangles.reshape(-1, 3).copy()) for mesh in shape.meshes]
        return torch.cat(corners).double()
    if len(shape.gaussians) > MOST_GAUSSIANS:
        raise DataError(f"more than {MOST_GAUSSIANS} Gaussians, expected one thing")
    seen = shape.gaussians.means[shape.gaussians.opacity > OPAQUE].double()
    if not len(seen):
        raise DataError("nothing opaque, expected a thing that can be seen")
    return seen


def _bounds(
    points: Float[Tensor, "points 3"], shape: ForeignShape
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Lowest and highest corner of the box, in the unit of the file."""
    if shape.gaussians is None:
        return points.amin(0), points.amax(0)
    # a stray Gaussian is no part of the body
    low, high = points.quantile(0.005, dim=0), points.quantile(0.995, dim=0)
    if shape.size_m is None:
        return low, high
    half = torch.tensor(shape.size_m).double() / 2
    if bool((torch.maximum(-low, high) > MOST_UNLIKE * half).any()):
        raise DataError(f"reaches out of the box of {_told(2 * half)} m that it says")
    return -half, half


def _size(
    sides: Float[Tensor, "3"], shape: ForeignShape, said: Placement
) -> tuple[Float[Tensor, "3"], float]:
    """The size in metres, and metres a unit of the file."""
    longest = float(sides.max())
    if not (0 < longest < math.inf and float(sides.min()) >= FLATTEST * longest):
        raise DataError(f"{_told(sides)} in its own unit, expected a thing with a volume")
    size_m, factor = sides * shape.unit_m, shape.unit_m
    if said.size_m is not None:
        size_m = torch.tensor(said.size_m).double()
        factor = float(size_m[0] / sides[0])
        ratio = sides * factor / size_m
        if float(torch.maximum(ratio, 1 / ratio).max()) > MOST_UNLIKE:
            raise DataError(
                f"{_told(sides * factor)} m at that length, expected about {_told(size_m)}: "
                "--size, --up or --forward are others"
            )
    least, most = LONGEST_M.get(said.category, ANY_LONGEST_M)
    if not least <= float(size_m.max()) <= most:
        raise DataError(
            f"{_told(size_m)} m, expected {least:g} to {most:g} m for the longest side of a "
            f"{said.category}: --size says how large it is"
        )
    return size_m, factor


def _told(sides: Float[Tensor, "3"]) -> str:
    return " x ".join(f"{side:.3g}" for side in sides.tolist())
