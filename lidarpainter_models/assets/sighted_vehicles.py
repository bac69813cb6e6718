"""What one run showed of a vehicle, kept beside it so that sightings can be fused.

Box frame: x along the length, y left, z up, origin at the centre; metres. Colours are in neutral
exposure. The file is small: only what was seen is in it, places and points to a millimetre or two.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.assets.seen_surfaces import SeenSurface, measured_points
from lidarpainter_models.assets.sightings import Look, Sighting
from lidarpainter_models.editing.actor_models import NEUTRAL_ROAD_RGB, exposure_gain
from lidarpainter_models.errors import DataError
from lidarpainter_models.lidar.vehicle_shapes import MeasuredPoints
from lidarpainter_models.storage.tensor_files import read_tensors, write_tensors

SIGHTED_FILE = "sighted.safetensors"
SUMS = ("pixels_per_m", "squared_error", "num_judged", "gradient", "true_gradient")
"""Numbers of a sighting that are kept as they are."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SightedVehicle:
    """A vehicle in the box of one run."""

    measured: MeasuredPoints
    """What its shape was fitted to."""
    places: Float[Tensor, "places 3"]
    """Those of its surface that an image showed."""
    normals: Float[Tensor, "places 3"]
    """Unit, out of it."""
    rgb: Float[Tensor, "places 3"]
    """Mean of the looks, in neutral exposure."""
    weight: Float[Tensor, " places"]
    """Evidence of the looks, as of `SeenSurface`."""
    variance: Float[Tensor, " places"]
    """Between the looks, as `SeenSurface.disagreement`."""
    sighting: Sighting

    @classmethod
    def of(cls, surface: SeenSurface, sighting: Sighting) -> "SightedVehicle":
        """What a run showed of a surface, its colours brought to neutral exposure."""
        rows = (surface.weight > 0).nonzero()[:, 0]
        gain, road_rgb = torch.ones(3), surface.model.road_rgb
        if road_rgb is not None:
            gain = exposure_gain(road_rgb, torch.tensor(NEUTRAL_ROAD_RGB))
        return cls(
            measured=measured_points(surface.model).thinned(),
            places=surface.places[rows],
            normals=surface.normals[rows],
            rgb=surface.rgb[rows] * gain,
            weight=surface.weight[rows],
            variance=surface.disagreement[rows] * gain.mean().square(),
            sighting=sighting,
        )


def write_sighted(path: Path, vehicle: SightedVehicle) -> None:
    """Write a vehicle to a file.

    Raises:
        WriteError: the disk refuses.
    """
    seen = vehicle.sighting
    tensors = {
        "points": vehicle.measured.points_box.half(),
        "point_weight": vehicle.measured.weight.half(),
        "places": vehicle.places.half(),
        "normals": (127 * vehicle.normals).round().to(torch.int8),
        "rgb": vehicle.rgb.half(),
        "weight": vehicle.weight.sqrt().half(),
        "variance": vehicle.variance.sqrt().half(),
        "cells": seen.cells.to(torch.uint8),
    }
    looks = [list(asdict(look).values()) for look in seen.looks]
    sums = {name: getattr(seen, name) for name in SUMS}
    write_tensors(path, tensors, {"looks": looks, **sums})


def read_sighted(path: Path) -> SightedVehicle:
    """Read a vehicle that `write_sighted` wrote.

    Raises:
        DataError: it is no such file, or damaged.
    """
    tensors, header = read_tensors(path)
    try:
        _check(tensors)
        looks = [Look(**dict(zip(Look.__slots__, one, strict=True))) for one in header["looks"]]
        seen = Sighting(
            looks=looks, cells=tensors.pop("cells").bool(), **{name: header[name] for name in SUMS}
        )
        own = {name: tensor.float() for name, tensor in tensors.items()}
        return SightedVehicle(
            measured=MeasuredPoints(own["points"], own["point_weight"]),
            places=own["places"],
            normals=torch.nn.functional.normalize(own["normals"], dim=1),
            rgb=own["rgb"],
            weight=own["weight"].square(),
            variance=own["variance"].square(),
            sighting=seen,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(f"{path}: expected what a run showed of a vehicle: {error!r}") from None


def _check(tensors: Mapping[str, Tensor]) -> None:
    """Refuse tensors of other shapes than `write_sighted` gives them, and numbers that are none.

    Raises:
        ValueError: they are so.
        KeyError: one is missing.
    """
    points, places = tensors["points"].shape[:1], tensors["places"].shape[:1]
    expected = {
        "points": (*points, 3),
        "point_weight": points,
        **dict.fromkeys(("places", "normals", "rgb"), (*places, 3)),
        **dict.fromkeys(("weight", "variance"), places),
        "cells": (6, 4, 4),
    }
    for name, shape in expected.items():
        if tensors[name].shape != shape or not bool(tensors[name].isfinite().all()):
            raise ValueError(f"{name} of shape {tuple(tensors[name].shape)}, expected {shape}")
