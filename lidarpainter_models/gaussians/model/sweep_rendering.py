"""A scene as a LiDAR meets it: each ray from where its sensor is then, actors where they are.

A sweep is cut into short pieces of time. In the middle of each the scene stands as
`scene_rendering` says it does at that moment, bent as people are and each body in its place; around
it bodies move on evenly, which within a few milliseconds is exact to millimetres. World: z up;
metres.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.scene_rendering import bent_at
from lidarpainter_models.geometry.transforms import rotation_from_quaternion
from lidarpainter_models.kernels.ray_gaussians import (
    BLENDED,
    Ellipsoids,
    RayHits,
    RayReturns,
    Rays,
    trace_rays,
)
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.firings import SweepRays

PIECE_NS = 10_000_000
"""How long the rays of a piece are apart at most."""
VELOCITY_NS = 5_000_000
"""Over which velocities are taken, to both sides."""
THINNEST_M = 2e-3
"""Gaussians are taken to be no thinner, which float32 could not tell at a hundred metres."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Solids:
    """Gaussians as rays meet them, in the frames of their bodies."""

    gaussians: GaussianSet
    channels: Float[Tensor, "gaussians channels"]
    """What is blended beside the range."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Piece:
    """Some rays of a sweep, and the middle of their times and origins."""

    rows: Int[Tensor, " rays"]
    time_ns: int
    origin_m: Float[Tensor, "3"]


def trace_sweep(
    scene: GaussianScene, solids: Solids, rays: SweepRays, *, most_hits: int = 0
) -> RayReturns:
    """Follow the rays of a sweep, in any order, through a scene's Gaussians; without gradient.

    Args:
        scene: whose bodies stand somewhere.
        solids: its Gaussians as rays meet them.
        rays: of one sweep or several.
        most_hits: how many answers of each ray are listed.
    """
    whole = _Street.of(solids)
    pieces = list(_pieces(rays))

    def traced(piece: _Piece) -> RayReturns:
        standing = whole.standing(scene.actors, solids, piece)
        own = Rays(
            origin_m=(rays.origin_m[piece.rows] - piece.origin_m).float(),
            direction=rays.direction[piece.rows].float(),
            after_s=((rays.time_ns[piece.rows] - piece.time_ns).double() * 1e-9).float(),
        )
        return trace_rays(own, standing, most_hits=most_hits)

    found = list(side_by_side(traced, pieces, scene.device))
    if not found:
        no_rays = Rays(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))
        return trace_rays(no_rays, whole.ellipsoids, most_hits=most_hits)
    rows = torch.cat([piece.rows for piece in pieces])
    back = torch.empty_like(rows)
    back[rows] = torch.arange(len(rows))
    hits = [one.hits for one in found]
    rest = {name: torch.cat([getattr(one, name) for one in found])[back] for name in BLENDED}
    return RayReturns(
        **rest, hits=RayHits(*(torch.cat(column)[back] for column in zip(*hits, strict=True)))
    )


def _pieces(rays: SweepRays) -> Iterator[_Piece]:
    """The rays by time, so many milliseconds each."""
    if not len(rays):
        return
    order = torch.argsort(rays.time_ns, stable=True)
    since_ns = rays.time_ns[order] - rays.time_ns[order[0]]
    number = since_ns // PIECE_NS
    for rows in order.split(torch.unique_consecutive(number, return_counts=True)[1].tolist()):
        times_ns, origins_m = rays.time_ns[rows], rays.origin_m[rows]
        yield _Piece(
            rows=rows,
            time_ns=int((times_ns[0] + times_ns[-1]) // 2),
            origin_m=(origins_m.amin(dim=0) + origins_m.amax(dim=0)) / 2,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Street:
    """All Gaussians in their own frames, of which only the actors' change from piece to piece."""

    ellipsoids: Ellipsoids
    means: Float[Tensor, "gaussians 3"]
    """float64: those of the street stand in the world."""
    of_actors: Int[Tensor, " some"]

    @classmethod
    def of(cls, solids: Solids) -> "_Street":
        gaussians = solids.gaussians
        return cls(
            ellipsoids=Ellipsoids(
                means=gaussians.means,
                axes=rotation_from_quaternion(gaussians.rotation_wxyz).mT,
                scale_m=gaussians.scale_m.clamp(min=THINNEST_M),
                opacity=gaussians.opacity,
                velocity_mps=torch.zeros_like(gaussians.means),
                channels=solids.channels,
            ),
            means=gaussians.means.double(),
            of_actors=(gaussians.body_index > 0).nonzero()[:, 0],
        )

    def standing(self, actors: Actors, solids: Solids, piece: _Piece) -> Ellipsoids:
        """The Gaussians around a piece's origin at its time."""
        means, whole = self.means - piece.origin_m, self.ellipsoids
        if not len(self.of_actors):
            return replace(whole, means=means.float())
        rows, own = self.of_actors, solids.gaussians.select(self.of_actors)
        bent = bent_at(own, actors, piece.time_ns)
        pose, rate, is_there = _bodies(actors, piece.time_ns)
        body = own.body_index.long() - 1
        placed = torch.einsum("gij,gj->gi", pose[body, :3, :3], bent.means.double())
        placed += pose[body, :3, 3]
        speed = torch.einsum("gij,gj->gi", rate[body, :3, :3], bent.means.double())
        changes = {
            "means": placed - piece.origin_m,
            "axes": whole.axes[rows] @ pose[body, :3, :3].mT.float(),
            "velocity_mps": speed + rate[body, :3, 3],
            "opacity": whole.opacity[rows] * is_there[body],
        }
        columns = {field.name: getattr(whole, field.name) for field in fields(whole)}
        columns["means"] = means.float()
        for name, values in changes.items():
            columns[name] = columns[name].index_copy(0, rows, values.float())
        return Ellipsoids(**columns)


def _bodies(
    actors: Actors, time_ns: int
) -> tuple[Float[Tensor, "actors 4 4"], Float[Tensor, "actors 4 4"], Bool[Tensor, " actors"]]:
    """World poses of the actors at a time, by how much they change a second, and who is there."""
    poses, present = actors.refined_poses(time_ns)
    before, after = (
        actors.recorded_poses(time_ns + step_ns)[0] for step_ns in (-VELOCITY_NS, VELOCITY_NS)
    )
    return poses, (after - before) / (2e-9 * VELOCITY_NS), present > 0
