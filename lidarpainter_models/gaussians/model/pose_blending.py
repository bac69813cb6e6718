"""Where a camera or an actor stood at a time between refined poses.

A recorded pose is noisy, a refined one is not, but only training times have one. Two guesses for
another time: (a) the refined poses interpolated, which forgets what was recorded there, and (b)
the recorded pose with the neighbours' corrections, which keeps the recorded noise. Which one is
better differs by axis and by log. Both are therefore tried on the refined times themselves, each
left out once, and mixed by inverse variance. No image of the asked time is used.

Tangents are (rotation vector in radians, translation in metres) in the body's own frame.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_tangent

# halving the gap to the neighbours divides the error of a cubic through smooth motion by 16; on a
# real road it is rough, and half the error (a quarter of the variance) is what is left
_CLOSER_NEIGHBOURS_VARIANCE = 1 / 4
_LEAST_VARIANCE = torch.tensor([1e-10] * 3 + [1e-8] * 3, dtype=torch.float64)


def tangent_from_rigid(
    target_from_source: Float[Tensor, "*batch 4 4"],
) -> Float[Tensor, "*batch 6"]:
    """Rotation vector (angles well below pi) and translation of rigid transforms."""
    rotation = target_from_source[..., :3, :3]
    twice = torch.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        dim=-1,
    )
    sine = twice.norm(dim=-1) / 2
    cosine = (rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    angle = torch.atan2(sine, cosine)
    factor = torch.where(sine > 1e-9, angle / sine.clamp(min=1e-9), torch.ones_like(sine)) / 2
    return torch.cat([twice * factor[..., None], target_from_source[..., :3, 3]], dim=-1)


def lagrange_weights(
    times_s: Float[Tensor, " times"], query_s: float, *, num_points: int = 4
) -> tuple[Int[Tensor, " points"], Float[Tensor, " points"]]:
    """Which samples, and with which weights, give the value of the polynomial through them.

    Up to `num_points` samples around the query are taken; outside the samples, where a polynomial
    would swing away, the line through the last two.
    """
    count = times_s.numel()
    after = int(torch.searchsorted(times_s, query_s))
    if after == 0 or after == count:
        num_points = min(2, count)
    points = min(num_points, count)
    first = min(max(after - points // 2, 0), count - points)
    rows = torch.arange(first, first + points)
    chosen = times_s[rows]
    weights = torch.ones(points, dtype=torch.float64)
    for i in range(points):
        for j in range(points):
            if i != j:
                weights[i] *= (query_s - chosen[j]) / (chosen[i] - chosen[j])
    return rows, weights


def interpolate_smoothly(
    times_s: Float[Tensor, " times"],
    world_from_body: Float[Tensor, "times 4 4"],
    query_s: float,
    *,
    num_points: int = 4,
) -> Float[Tensor, "4 4"]:
    """A pose on the cubic through the neighbouring poses, in the tangent space of the nearest."""
    rows, weights = lagrange_weights(times_s, query_s, num_points=num_points)
    anchor = world_from_body[rows[int((times_s[rows] - query_s).abs().argmin())]]
    tangents = tangent_from_rigid(invert_rigid(anchor) @ world_from_body[rows])
    return anchor @ rigid_from_tangent((weights[:, None] * tangents).sum(dim=0))


@dataclass(frozen=True, kw_only=True, eq=False)
class RefinedTrack:
    """Recorded and refined poses of one camera or actor at ascending times."""

    times_s: Float[Tensor, " times"]
    recorded: Float[Tensor, "times 4 4"]
    refined: Float[Tensor, "times 4 4"]

    def pose_at(self, query_s: float, recorded: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
        """The most likely pose at a time with the given recorded pose."""
        corrected = self.with_neighbours_correction(query_s, recorded)
        if self.times_s.numel() < 2:
            return corrected
        if not float(self.times_s[0]) < query_s < float(self.times_s[-1]):
            return corrected
        moved = interpolate_smoothly(self.times_s, self.refined, query_s)
        difference = tangent_from_rigid(invert_rigid(corrected) @ moved)
        return corrected @ rigid_from_tangent(self.trust_in_motion * difference)

    def with_neighbours_correction(
        self, query_s: float, recorded: Float[Tensor, "4 4"]
    ) -> Float[Tensor, "4 4"]:
        """The recorded pose, corrected as its two neighbours in time are on average."""
        rows, weights = lagrange_weights(self.times_s, query_s, num_points=2)
        if query_s <= float(self.times_s[0]) or query_s >= float(self.times_s[-1]):
            rows = rows[(self.times_s[rows] - query_s).abs().argmin()][None]
            weights = torch.ones(1, dtype=torch.float64)
        corrections = tangent_from_rigid(invert_rigid(self.recorded[rows]) @ self.refined[rows])
        return recorded @ rigid_from_tangent((weights[:, None] * corrections).sum(dim=0))

    @cached_property
    def trust_in_motion(self) -> Float[Tensor, "6"]:
        """Weight of the interpolated motion between refined times, per tangent axis, in [0, 1].

        Each inner refined time is left out and guessed both ways; its neighbours are then twice as
        far as those of a time between refined ones, for which the motion's error is scaled down.
        """
        count = self.times_s.numel()
        if count < 5:
            return torch.zeros(6, dtype=torch.float64)
        motion_error, correction_error = [], []
        for left_out in range(1, count - 1):
            kept = torch.arange(count) != left_out
            rest = RefinedTrack(
                times_s=self.times_s[kept], recorded=self.recorded[kept], refined=self.refined[kept]
            )
            time_s, truth = float(self.times_s[left_out]), invert_rigid(self.refined[left_out])
            moved = interpolate_smoothly(rest.times_s, rest.refined, time_s)
            corrected = rest.with_neighbours_correction(time_s, self.recorded[left_out])
            motion_error.append(tangent_from_rigid(truth @ moved))
            correction_error.append(tangent_from_rigid(truth @ corrected))
        motion = torch.stack(motion_error).square().mean(0) * _CLOSER_NEIGHBOURS_VARIANCE
        correction = torch.stack(correction_error).square().mean(0)
        return (correction + _LEAST_VARIANCE) / (motion + correction + 2 * _LEAST_VARIANCE)
