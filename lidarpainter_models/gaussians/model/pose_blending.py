"""Where a camera or an actor stood at a time between refined poses.

A recorded pose is noisy, a refined one is not, but only training times have one. Two guesses for
another time: (a) the refined poses interpolated, which forgets what was recorded there, and (b)
the recorded pose with the neighbours' corrections, which keeps the recorded noise. Which one is
better differs by axis and by log. Both are therefore tried on the refined times themselves, each
left out once, and mixed by inverse variance. No image of the asked time is used.

All bodies and all times asked for are treated at once. Tangents are (rotation vector in radians,
translation in metres) in the body's own frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_tangent

# halving the gap to the neighbours divides the error of a cubic through smooth motion by 16; on a
# real road it is rough, and half the error (a quarter of the variance) is what is left
_CLOSER_NEIGHBOURS_VARIANCE = 1 / 4
_CUBIC, _LINE = 4, 2  # samples that a polynomial goes through
_LEAST_TO_TRUST = 5
"""Refined times of a body from which on it is tried out how smoothly it moves."""
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


class Samples(NamedTuple):
    """Which samples of each query's body, and with which weights, give a value between them."""

    rows: Int[Tensor, "queries points"]
    weights: Float[Tensor, "queries points"]
    nearest: Int[Tensor, " queries"]
    """The row next in time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RefinedTracks:
    """Recorded and refined poses of cameras or actors at ascending times, float64."""

    times_s: Float[Tensor, "bodies times"]
    """Infinite behind a body's last time."""
    recorded: Float[Tensor, "bodies times 4 4"]
    refined: Float[Tensor, "bodies times 4 4"]

    @classmethod
    def of(
        cls,
        times_s: Sequence[Float[Tensor, " _"]],
        recorded: Sequence[Float[Tensor, "_ 4 4"]],
        refined: Sequence[Float[Tensor, "_ 4 4"]],
    ) -> "RefinedTracks":
        """Bodies of at least one time each."""
        if not times_s:
            none = torch.zeros(0, 1, 4, 4, dtype=torch.float64)
            return cls(times_s=none[..., 0, 0], recorded=none, refined=none)
        return cls(
            times_s=pad_sequence(list(times_s), batch_first=True, padding_value=torch.inf),
            recorded=pad_sequence(list(recorded), batch_first=True),
            refined=pad_sequence(list(refined), batch_first=True),
        )

    def pose_at(
        self, body: int, query_s: float, recorded: Float[Tensor, "4 4"]
    ) -> Float[Tensor, "4 4"]:
        """The refined pose of one body at a time; see `poses_at`."""
        time_s = torch.tensor([query_s], dtype=torch.float64)
        return self.poses_at(torch.tensor([body]), time_s, recorded[None])[0]

    def poses_at(
        self,
        bodies: Int[Tensor, " queries"],
        query_s: Float[Tensor, " queries"],
        recorded: Float[Tensor, "queries 4 4"],
    ) -> Float[Tensor, "queries 4 4"]:
        """The refined poses of bodies at any times, given the poses recorded there."""
        known_s, count = self.times_s[bodies], self._counts[bodies]
        after = torch.searchsorted(known_s, query_s[:, None])[:, 0]
        line = _samples(known_s, count, after, query_s, _LINE)
        queries = torch.arange(len(bodies))
        is_inside = (known_s[:, 0] < query_s) & (query_s < known_s[queries, count - 1])
        # beyond its ends a body keeps the correction of the end
        ends = torch.nn.functional.one_hot((line.rows == line.nearest[:, None]).int().argmax(1), 2)
        weights = torch.where(is_inside[:, None], line.weights, ends.double())
        corrected = self._corrected(bodies, line._replace(weights=weights), recorded)
        moved = self._moved(bodies, _samples(known_s, count, after, query_s, _CUBIC))
        difference = tangent_from_rigid(invert_rigid(corrected) @ moved)
        blended = corrected @ rigid_from_tangent(self.trust_in_motion[bodies] * difference)
        return torch.where(is_inside[:, None, None], blended, corrected)

    @cached_property
    def trust_in_motion(self) -> Float[Tensor, "bodies 6"]:
        """Weight of the interpolated motion between refined times, per tangent axis, in [0, 1].

        Each inner refined time is left out and guessed both ways; its neighbours are then twice as
        far as those of a time between refined ones, for which the motion's error is scaled down.
        """
        inner = torch.arange(self.times_s.shape[1]) < self._counts[:, None] - 1
        inner[:, 0] = False
        bodies, left_out = (inner & (self._counts[:, None] >= _LEAST_TO_TRUST)).nonzero().unbind(1)
        query_s, count = self.times_s[bodies, left_out], self._counts[bodies] - 1
        truth = invert_rigid(self.refined[bodies, left_out])
        line, cubic = (
            _samples(self.times_s[bodies], count, left_out, query_s, points, left_out=left_out)
            for points in (_LINE, _CUBIC)
        )
        moved = self._moved(bodies, cubic)
        corrected = self._corrected(bodies, line, self.recorded[bodies, left_out])
        motion, correction = (
            self._mean(bodies, tangent_from_rigid(truth @ guess).square())
            for guess in (moved, corrected)
        )
        motion = motion * _CLOSER_NEIGHBOURS_VARIANCE
        trust = (correction + _LEAST_VARIANCE) / (motion + correction + 2 * _LEAST_VARIANCE)
        return torch.where((self._counts >= _LEAST_TO_TRUST)[:, None], trust, 0)

    @cached_property
    def _counts(self) -> Int[Tensor, " bodies"]:
        return self.times_s.isfinite().sum(dim=1)

    @cached_property
    def _corrections(self) -> Float[Tensor, "bodies times 6"]:
        return tangent_from_rigid(invert_rigid(self.recorded) @ self.refined)

    def _corrected(
        self, bodies: Int[Tensor, " queries"], line: Samples, recorded: Float[Tensor, "queries 4 4"]
    ) -> Float[Tensor, "queries 4 4"]:
        """The recorded poses, corrected as their neighbours in time are on average."""
        corrections = self._corrections[bodies[:, None], line.rows]
        return recorded @ rigid_from_tangent((line.weights[..., None] * corrections).sum(dim=1))

    def _moved(
        self, bodies: Int[Tensor, " queries"], cubic: Samples
    ) -> Float[Tensor, "queries 4 4"]:
        """Poses on the cubic through refined ones, in the tangent space of the nearest."""
        anchor = self.refined[bodies, cubic.nearest]
        around = invert_rigid(anchor)[:, None] @ self.refined[bodies[:, None], cubic.rows]
        step = (cubic.weights[..., None] * tangent_from_rigid(around)).sum(dim=1)
        return anchor @ rigid_from_tangent(step)

    def _mean(
        self, bodies: Int[Tensor, " queries"], values: Float[Tensor, "queries 6"]
    ) -> Float[Tensor, "bodies 6"]:
        sums = values.new_zeros(len(self.times_s), 6).index_add(0, bodies, values)
        return sums / bodies.bincount(minlength=len(self.times_s)).clamp(min=1)[:, None]


def _samples(
    known_s: Float[Tensor, "queries times"],
    count: Int[Tensor, " queries"],
    after: Int[Tensor, " queries"],
    query_s: Float[Tensor, " queries"],
    num_points: int,
    *,
    left_out: Int[Tensor, " queries"] | None = None,
) -> Samples:
    """Samples around each query and the weights of the polynomial through them (Lagrange).

    Outside the samples, where a polynomial would swing away, it is the line through the last two.
    `count` is without the one that is `left_out`, `after` says how many are earlier than the query;
    `num_points` are taken, if there are as many.
    """
    is_end = (after == 0) | (after == count)
    points = torch.where(is_end, _LINE, num_points).minimum(count)
    first = (after - points // 2).clamp(min=0).minimum(count - points)
    place = torch.arange(num_points)
    is_used = place < points[:, None]
    rows = torch.where(is_used, first[:, None] + place, first[:, None])
    if left_out is not None:
        rows = rows + (rows >= left_out[:, None]).long()
    chosen_s = known_s.gather(1, rows)
    others = is_used[:, None, :] & (place != place[:, None])
    steps = chosen_s[:, :, None] - chosen_s[:, None, :]
    factors = (query_s[:, None] - chosen_s)[:, None, :] / torch.where(others, steps, 1)
    weights = torch.where(others, factors, 1).prod(dim=-1)
    away_s = torch.where(is_used, (chosen_s - query_s[:, None]).abs(), torch.inf)
    nearest = rows.gather(1, away_s.argmin(dim=1, keepdim=True))[:, 0]
    return Samples(rows, torch.where(is_used, weights, 0), nearest)
