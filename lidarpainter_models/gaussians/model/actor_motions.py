"""Where the actors were at any time, from their boxes and what was corrected about them.

Box frame: x along the length, y left, z up, origin at the centre.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.corrections import ActorCorrections
from lidarpainter_models.gaussians.model.pose_blending import RefinedTrack
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.scenes.driving_scene import ActorTrack

PRESENCE_MARGIN_NS = 60_000_000
"""An actor stays for half a 10 Hz frame (and a little) beyond its first and last box."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ActorMotions:
    """Every actor's recorded and refined poses at the training times of its presence."""

    tracks: tuple[ActorTrack, ...]
    tangent: Float[Tensor, "actors knots 6"]
    """The corrections that the refined poses were made from."""
    refined: tuple[RefinedTrack | None, ...]
    """None for an actor that is never present at a training time."""

    @classmethod
    def of(cls, tracks: Sequence[ActorTrack], corrections: ActorCorrections) -> "ActorMotions":
        """Motions of tracks with these corrections."""
        tangent = corrections.tangent.detach().clone()
        knots = corrections.knots_ns.tolist()
        found: list[RefinedTrack | None] = []
        for index, track in enumerate(tracks):
            rows = [row for row, knot in enumerate(knots) if _is_present(track, knot)]
            if not rows:
                found.append(None)
                continue
            recorded = torch.stack([track.pose_at(knots[row]).double() for row in rows])
            found.append(
                RefinedTrack(
                    times_s=corrections.knots_ns[rows].double() * 1e-9,
                    recorded=recorded,
                    refined=recorded @ rigid_from_tangent(tangent[index, rows]),
                )
            )
        return cls(tracks=tuple(tracks), tangent=tangent, refined=tuple(found))

    def pose_at(self, index: int, timestamp_ns: int) -> Float[Tensor, "4 4"]:
        """Most likely pose of one actor at a time."""
        recorded = self.tracks[index].pose_at(timestamp_ns).double()
        refined = self.refined[index]
        return recorded if refined is None else refined.pose_at(timestamp_ns * 1e-9, recorded)


def _is_present(track: ActorTrack, timestamp_ns: int) -> bool:
    return track.is_present(timestamp_ns, PRESENCE_MARGIN_NS)
