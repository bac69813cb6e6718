"""How far one frame can be trusted, for a simulator that asks for it.

The confidence is that of `evaluation/view_confidence`. The distance says how far a camera stands
outside of what the envelope of the run trusts: 0 inside, and in metres beyond it, from the place of
the recorded path that is nearest to the camera.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView

KEYS = (
    "lidarpainter-confidence",
    "lidarpainter-predicted-psnr-db",
    "lidarpainter-envelope-distance-m",
)
"""Trailing metadata of a reply; of a batch a list with commas, in the order of its items."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trust:
    """What is said of a frame; None where nothing is known."""

    confidence: float | None = None
    """Probability of 25 dB or better."""
    predicted_db: float | None = None
    distance_m: float | None = None
    """Outside of the envelope, in metres; 0 inside."""

    def words(self) -> tuple[str, str, str]:
        """The values of `KEYS`; nothing where nothing is known."""
        numbers = (self.confidence, self.predicted_db, self.distance_m)
        first, second, third = ("" if n is None else f"{n:.4f}" for n in numbers)
        return first, second, third


def metadata(trusts: Sequence[Trust]) -> tuple[tuple[str, str], ...]:
    """What is said of the frames of a reply, as trailing metadata."""
    columns = zip(*(trust.words() for trust in trusts), strict=True)
    return tuple((key, ",".join(column)) for key, column in zip(KEYS, columns, strict=True))


class EnvelopeDistance:
    """Distances from the trusted space around one camera's recorded path."""

    def __init__(
        self, envelope: Mapping[str, Any], recorded: DrivingScene, views: Sequence[RecordedView]
    ) -> None:
        """Take the envelope of a run, and where a camera and its car were at its views."""
        frame_indices = [view.frame_index for view in views]
        cars = recorded.world_from_ego[[recorded.frame_position(index) for index in frame_indices]]
        self._centres = torch.stack([view.camera.centre_world.double() for view in views])
        self._ego_from_world = invert_rigid(cars.double())[:, :3, :3]
        stretches = envelope["stretches"]
        rows: list[Mapping[str, Any]] = [
            next((one for one in stretches if one["first_frame"] <= index <= one["last_frame"]), {})
            for index in frame_indices
        ]
        names = ("left_m", "right_m", "up_m", "ahead_m")
        self._reach_m = torch.tensor(
            [[row.get(name) or 0.0 for name in names] for row in rows], dtype=torch.float64
        )

    def of(self, world_from_camera: Float[Tensor, "4 4"]) -> float:
        """How far outside a camera stands, metres."""
        aside = world_from_camera[:3, 3].double() - self._centres
        nearest = int(aside.square().sum(dim=1).argmin())
        ahead, left, up = (self._ego_from_world[nearest] @ aside[nearest]).tolist()
        left_m, right_m, up_m, ahead_m = self._reach_m[nearest].tolist()
        is_end = nearest == len(self._centres) - 1
        beside = self._centres[max(nearest - 1, 0) : nearest + 2]
        # half way to the next recorded place, at most: so far along counts as on the path
        gap = float(beside.diff(dim=0).norm(dim=1).max()) if len(beside) > 1 else 0.0
        along = max(ahead - (ahead_m if is_end else gap), -ahead - gap, 0.0)
        across = max(left - left_m, -left - right_m, 0.0)
        return math.hypot(along, across, max(up - up_m, -up - up_m, 0.0))
