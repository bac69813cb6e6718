"""What a LiDAR meets in a scene and what comes back: intensity, loss and noise, as learnt.

Surfels stand in the frames of their bodies, as Gaussians do, and know their actors by id: so they
go where a changed scene's actors go, and leave with those that it lacks.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.gaussians.lidar_returns.weather import Air
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.placing import joined_gaussians
from lidarpainter_models.gaussians.model.sweep_rendering import Solids, trace_sweep
from lidarpainter_models.kernels.ray_gaussians import RayHits, blended_hits
from lidarpainter_models.lidar.firings import SweepRays
from lidarpainter_models.storage.tensor_files import grouped

SCHEMA = 1
FAR_M = 50.0
"""Ranges are told to the heads in this unit."""
WINDOW_M = 0.2
"""What is measured is the mean of what stops a ray so near to where half of it has been stopped."""
LISTED = 16
"""Answers of a ray among which that mean is taken."""
APART_M, LEAST_SECOND = 0.6, 0.25
"""A second return lies so far from the first, where this part of the ray has been stopped."""
NOISE_EDGES_M = (0.0, 10.0, 20.0, 40.0, 80.0)
"""From each of these ranges on noise is measured apart."""
DROP_INPUTS, STRENGTH_INPUTS, HIDDEN = 6, 4, 16


class Heads(torch.nn.Module):
    """Two small networks over what a ray has met."""

    def __init__(self) -> None:
        """Start with no say: surfels alone decide."""
        super().__init__()
        self.drop = _head(DROP_INPUTS)
        self.strength = _head(STRENGTH_INPUTS)

    def forward(self, met: "MetSurfaces") -> tuple[Float[Tensor, " rays"], Float[Tensor, " rays"]]:
        """Logit of the chance that a ray is lost, and intensity in [0, 1]."""
        far, stopped = met.range_m / FAR_M, met.alpha.clamp(max=0.9999)
        clear = torch.log(1e-3 + 1 - stopped)
        about = torch.stack([far, met.cosine, stopped, met.drop, clear, met.strength], dim=1)
        lost = met.drop + self.drop(about)[:, 0]
        near = torch.log1p(met.range_m) / 3
        about = torch.stack([far, met.cosine, near, stopped], dim=1)
        return lost, torch.sigmoid(met.strength + self.strength(about)[:, 0])


def _head(inputs: int) -> torch.nn.Sequential:
    last = torch.nn.Linear(HIDDEN, 1)
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.zeros_(last.bias)
    return torch.nn.Sequential(torch.nn.Linear(inputs, HIDDEN), torch.nn.GELU(), last)


@dataclass(frozen=True, eq=False, kw_only=True)
class MetSurfaces:
    """What rays have met, blended; 0 where they met nothing."""

    range_m: Float[Tensor, " rays"]
    alpha: Float[Tensor, " rays"]
    cosine: Float[Tensor, " rays"]
    strength: Float[Tensor, " rays"]
    """Logit of the intensity, as the surfels have it."""
    drop: Float[Tensor, " rays"]
    """Logit of the chance of being lost, likewise."""


class Returns(NamedTuple):
    """What comes back of some rays."""

    ray: Int[Tensor, " returns"]
    range_m: Float[Tensor, " returns"]
    body: Int[Tensor, " returns"]
    number: Int[Tensor, " returns"]
    """Among those of its ray, the nearest first."""

    def xyz_m(self, rays: SweepRays) -> Float[Tensor, "returns 3"]:
        """Where they lie; world, float64."""
        away_m = self.range_m[:, None].double() * rays.direction[self.ray]
        return rays.origin_m[self.ray] + away_m


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedSweep:
    """What a LiDAR would measure along some rays."""

    range_m: Float[Tensor, " rays"]
    """Distance of the strongest return; 0 where the rays meet nothing."""
    second_m: Float[Tensor, " rays"]
    """Distance of the next strongest, before or behind it; 0 where there is none."""
    intensity: Float[Tensor, " rays"]
    """In the sensor's own unit."""
    lost: Float[Tensor, " rays"]
    """Chance that nothing comes back."""
    is_returned: Bool[Tensor, " rays"]
    """Whether something does: by that chance, or by a draw."""
    body: Int[Tensor, " rays"]
    """Body of the scene that is met; -1 where none is."""
    second_body: Int[Tensor, " rays"]
    """Body that the second return is of."""
    alpha: Float[Tensor, " rays"]

    def returns(self, most: int) -> "Returns":
        """What comes back, at most one or two returns of a ray."""
        first = self.is_returned.nonzero()[:, 0]
        number = torch.zeros_like(first)
        if most < 2:
            return Returns(first, self.range_m[first], self.body[first], number)
        second = (self.is_returned & (self.second_m > 0)).nonzero()[:, 0]
        is_nearer = (self.second_m > 0) & (self.second_m < self.range_m)
        return Returns(
            ray=torch.cat([first, second]),
            range_m=torch.cat([self.range_m[first], self.second_m[second]]),
            body=torch.cat([self.body[first], self.second_body[second]]),
            number=torch.cat([is_nearer[first], ~is_nearer[second]]).long(),
        )

    def cluttered(self, air_m: Float[Tensor, " rays"]) -> "SimulatedSweep":
        """The same where the air sends some rays back, from how far (inf: not this one)."""
        is_air = torch.isfinite(air_m)
        told: dict[str, Any] = {"range_m": air_m, "second_m": 0.0, "intensity": 0.0, "lost": 0.0}
        told |= {"is_returned": True, "body": -1, "alpha": 1.0}
        changes = {
            name: torch.where(is_air, value, getattr(self, name)) for name, value in told.items()
        }
        return replace(self, **changes)


@dataclass(frozen=True, eq=False, kw_only=True)
class LidarChannel:
    """Surfels of a log and what they send back to one of its LiDARs."""

    surfels: GaussianSet
    actor_ids: tuple[str, ...]
    """The actors that the surfels' bodies 1, 2, ... are."""
    strength: Float[Tensor, " surfels"]
    """Logit of the intensity."""
    drop: Float[Tensor, " surfels"]
    """Logit of the chance that a ray is lost."""
    heads: Heads
    noise_m: Float[Tensor, " bands"]
    """Spread of measured ranges, by `NOISE_EDGES_M`."""
    full_intensity: float
    """What the sensor reports of the brightest surface."""

    def solids(self, scene: GaussianScene) -> Solids:
        """What rays meet in a scene that this log's fit, or a change of it, has given.

        Strength and drop are its channels, bodies those of the scene.
        """
        surfels, kept = in_bodies_of(scene, self.surfels, self.actor_ids)
        channels = torch.stack([self.strength, self.drop], dim=1)[kept]
        tracks = enumerate(scene.actors.recorded_tracks, 1)
        unswept = [row for row, track in tracks if track.actor_id not in self.actor_ids]
        rows = torch.isin(
            scene.gaussians.body_index.long(), torch.tensor(unswept, dtype=torch.int64)
        )
        if bool(rows.any()):
            others = scene.gaussians.select(rows.nonzero()[:, 0])
            no_harmonics = torch.zeros(len(others), 0, 3)
            others = replace(others, sh_dc=torch.zeros(len(others), 1, 3), sh_rest=no_harmonics)
            surfels = joined_gaussians([surfels, others])
            usual = channels.median(dim=0).values.expand(len(others), 2)
            channels = torch.cat([channels, usual])
        return Solids(gaussians=surfels, channels=channels)

    @torch.no_grad()
    def simulated(
        self, scene: GaussianScene, rays: SweepRays, *, seed: int | None = None
    ) -> SimulatedSweep:
        """What the LiDAR would measure along some rays.

        Args:
            scene: a fit of this log, or a change of one.
            rays: of any sensor, from anywhere.
            seed: draws what is lost, and noise; None takes what is likelier, without noise.
        """
        solids = self.solids(scene)
        bodies = solids.gaussians.body_index.long()
        found = trace_sweep(scene, solids, rays, most_hits=LISTED)
        share = 1 / found.alpha.clamp(min=1e-4)
        met = MetSurfaces(
            range_m=found.range_m,
            alpha=found.alpha,
            cosine=found.cosine * share,
            strength=found.channels[:, 0] * share,
            drop=found.channels[:, 1] * share,
        )
        logit, intensity = self.heads(met)
        range_m, second_m, second = measured_ranges(
            found.hits, solids.gaussians.opacity, found.median_m
        )
        range_m = torch.where(torch.isfinite(range_m), range_m, found.range_m)
        lost = torch.where(found.alpha > 0, torch.sigmoid(logit), 1.0)
        air = Air.of(scene.style, int(rays.time_ns.median())) if len(rays) else None
        clear = intensity
        if air is not None:
            intensity, lost = air.dimmed(range_m, clear, lost)
        random = None if seed is None else torch.Generator().manual_seed(seed)
        is_returned = lost < 0.5
        if random is not None:
            is_returned = torch.rand(len(lost), generator=random) >= lost
            band = torch.bucketize(range_m, torch.tensor(NOISE_EDGES_M[1:]))
            range_m = range_m + self.noise_m[band] * torch.randn(len(lost), generator=random)
        is_met = found.alpha > 0
        told = SimulatedSweep(
            range_m=range_m.clamp(min=0),
            second_m=second_m,
            intensity=self.full_intensity * intensity,
            lost=lost,
            is_returned=is_returned & is_met,
            body=torch.where(found.nearest >= 0, bodies[found.nearest.clamp(min=0)], -1),
            second_body=torch.where(second_m > 0, bodies[second.clamp(min=0)], -1),
            alpha=found.alpha,
        )
        if air is None:
            return told
        surface_m = torch.where(is_met, told.range_m, torch.inf)
        return told.cluttered(air.clutter_m(surface_m, clear, random))

    def to_arrays(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Arrays and JSON-able metadata; `channel_from_arrays` inverts it bitwise."""
        arrays = {f"surfels.{name}": value for name, value in self.surfels.columns().items()}
        arrays |= {f"heads.{name}": value for name, value in self.heads.state_dict().items()}
        arrays |= {"strength": self.strength, "drop": self.drop, "noise_m": self.noise_m}
        return (
            {name: value.detach().contiguous() for name, value in arrays.items()},
            {
                "schema": SCHEMA,
                "actor_ids": list(self.actor_ids),
                "full_intensity": self.full_intensity,
            },
        )


def channel_from_arrays(arrays: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> LidarChannel:
    """Rebuild a stored channel.

    Raises:
        SceneError: it was written by another version or is incomplete.
    """
    if metadata.get("schema") != SCHEMA:
        raise SceneError(
            f"a stored LiDAR channel has schema {metadata.get('schema')}, not {SCHEMA}"
        )
    groups, heads = grouped(arrays), Heads()
    try:
        heads.load_state_dict(groups["heads"])
        return LidarChannel(
            surfels=GaussianSet(**groups["surfels"]),
            actor_ids=tuple(metadata["actor_ids"]),
            strength=arrays["strength"],
            drop=arrays["drop"],
            heads=heads.requires_grad_(requires_grad=False),
            noise_m=arrays["noise_m"],
            full_intensity=float(metadata["full_intensity"]),
        )
    except (KeyError, TypeError, RuntimeError) as error:
        raise SceneError(f"a stored LiDAR channel is incomplete: {error}") from error


def measured_ranges(
    hits: RayHits,
    opacity: Float[Tensor, " gaussians"],
    median_m: Float[Tensor, " rays"],
) -> tuple[Float[Tensor, " rays"], Float[Tensor, " rays"], Int[Tensor, " rays"]]:
    """The ranges that rays return from.

    Returns:
        The mean of what stops a ray near its median, the median itself where nothing is listed;
        likewise around the Gaussian that stops most of it elsewhere, 0 where that is too little;
        and the row of that Gaussian.
    """
    weight = blended_hits(hits, opacity)

    def mean_around(place_m: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        near = weight * ((hits.range_m - place_m[:, None]).abs() < WINDOW_M)
        total = near.sum(dim=1)
        return (near * hits.range_m).sum(dim=1) / total.clamp(min=1e-6), total

    mean_m, total = mean_around(median_m, weight)
    first_m = torch.where(total > 0, mean_m, median_m)
    elsewhere = weight * ((hits.range_m - first_m[:, None]).abs() >= APART_M)
    most = elsewhere.argmax(dim=1, keepdim=True)
    second_m, total = mean_around(hits.range_m.gather(1, most)[:, 0], elsewhere)
    row = hits.row.gather(1, most)[:, 0]
    return first_m, torch.where(total >= LEAST_SECOND, second_m, 0.0), row


def in_bodies_of(
    scene: GaussianScene, surfels: GaussianSet, actor_ids: Sequence[str]
) -> tuple[GaussianSet, Int[Tensor, " kept"]]:
    """The surfels of the street and of those actors that a scene has, in its bodies; their rows."""
    known = {track.actor_id: row for row, track in enumerate(scene.actors.recorded_tracks, 1)}
    body_of = torch.tensor([0, *(known.get(name, -1) for name in actor_ids)])
    body = body_of[surfels.body_index.long()]
    kept = (body >= 0).nonzero()[:, 0]
    found = surfels.select(kept)
    return replace(found, body_index=body[kept].to(found.body_index)), kept
