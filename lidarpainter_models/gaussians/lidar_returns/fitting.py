"""Learn from a log's training sweeps which surfels are there, how bright they are and what is lost.

Rays are followed once through all surfels, and once more half-way; in between what each ray has
met stays in the same order, so a step is a few sums over lists. Surfels where rays went through
turn clear, each moves a little along its normal, and two small heads learn what range and incidence
do to intensity and loss (after NeuRAD, Tonderski et al., 2024). The fitted scene stays as it is.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.gaussians.initialisation.adaptive_voxels import Cloud, adaptive_voxels
from lidarpainter_models.gaussians.initialisation.surfels import surfels_from_points
from lidarpainter_models.gaussians.lidar_returns.channel import (
    NOISE_EDGES_M,
    Heads,
    LidarChannel,
    MetSurfaces,
    in_bodies_of,
)
from lidarpainter_models.gaussians.lidar_returns.settings import LidarConfig
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, axes_at
from lidarpainter_models.gaussians.model.placing import joined_gaussians
from lidarpainter_models.gaussians.model.sweep_rendering import Solids, trace_sweep
from lidarpainter_models.kernels.ray_gaussians import RayHits, blended_hits
from lidarpainter_models.lidar.firings import MountedLidar, SweepRays, recorded_rays
from lidarpainter_models.lidar.map_building import gather_points
from lidarpainter_models.scenes.driving_scene import DrivingScene

SOFT_M, LOST_M = 0.05, 5.0
"""Errors count as the logarithm of one and this part of them; a ray that is not stopped as this."""
MOVED_M, MOVED_WEIGHT = 0.05, 0.1
"""How far along its normal a surfel may be expected to move, and how much that counts."""
STEEPEST = 5.0
"""Metres of range per metre along the normal, at most: grazing rays say little of it."""
INTENSITY_WEIGHT = 20.0
RATES = {"opacity": 0.1, "offset": 2e-3, "strength": 0.1, "drop": 0.1, "heads": 5e-3}
SLOW_FROM, SLOWER = 0.6, 0.3
"""From this part of the steps on rates are so much lower."""
FIRST_STRENGTH = -1.5
CARVED, PASSED_M, PASSES, CLEAR = 2, 0.2, 2.0, -4.0
"""So often surfels are looked for that rays went through: behind whose plane they ended by so much,
so many times as often as at it. Those begin with this logit of opacity: who passed in a training
sweep and has no box would stand in the way of all others."""


def fit_lidar(
    scene: DrivingScene,
    fitted: GaussianScene,
    lidar: MountedLidar,
    frames: Sequence[int],
    config: LidarConfig,
    *,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> LidarChannel:
    """Learn what a LiDAR sees of a log.

    Args:
        scene: the log, its poses as the fit corrected them.
        fitted: whose actors stand where the fit found them; it is not changed.
        lidar: the sensor, and the way it went.
        frames: the training frames: no other sweep is read.
        config: how much is learnt.
        progress: told how many steps of how many are done.

    Raises:
        SceneError: the LiDAR swept in none of the frames, or met nothing.
    """
    sweeps = _sweeps(scene, lidar, frames, config)
    surfels, actor_ids = surfels_of(scene, frames, most=config.num_surfels)
    placed, kept = in_bodies_of(fitted, surfels, actor_ids)
    surfels = surfels.select(kept)
    if not len(surfels):
        raise SceneError(f"{scene.path.name}: the sweeps of its training frames met nothing")
    rays = SweepRays.joined(sweeps)
    full = 255.0 if float(rays.intensity.max()) > 1.0 else 1.0
    target = _Target(
        range_m=rays.range_m.float(),
        is_returned=rays.is_returned,
        intensity=(rays.intensity / full).clamp(0, 1),
    )
    learnt = _Learnt.start(surfels, config.seed)

    def met() -> RayHits:
        return learnt.met(fitted, placed.body_index, sweeps, config.hits)

    hits = _learn(learnt, met, target, config, progress)
    return LidarChannel(
        surfels=learnt.surfels_now(),
        actor_ids=actor_ids,
        strength=learnt.strength.detach(),
        drop=learnt.drop.detach(),
        heads=learnt.heads.requires_grad_(requires_grad=False),
        noise_m=learnt.noise(hits, target),
        full_intensity=full,
    )


def _learn(
    learnt: "_Learnt",
    met: Callable[[], RayHits],
    target: "_Target",
    config: LidarConfig,
    progress: Callable[[int, int], None],
) -> RayHits:
    """Take all steps; returns what the rays have met last."""
    random = torch.Generator().manual_seed(config.seed)
    for _ in range(CARVED):
        learnt.carve(met(), target)
    optimiser, hits = learnt.optimiser(), met()
    for step in range(config.steps):
        if step > 0 and step == config.steps // 2:
            hits = met()
        if step == int(SLOW_FROM * config.steps):
            for group in optimiser.param_groups:
                group["lr"] *= SLOWER
        rows = torch.randint(len(target.range_m), (config.rays_per_step,), generator=random)
        own = RayHits(*(column[rows] for column in hits))
        optimiser.zero_grad(set_to_none=True)
        learnt.loss(own, target.select(rows)).backward()
        optimiser.step()
        progress(step + 1, config.steps)
    return hits


def _sweeps(
    scene: DrivingScene, lidar: MountedLidar, frames: Sequence[int], config: LidarConfig
) -> list[SweepRays]:
    """Some rays of each training sweep of the LiDAR."""
    wanted = set(frames)
    swept = [
        sweep
        for sweep in scene.sweeps
        if sweep.frame_index in wanted and sweep.lidar_name == lidar.name
    ]
    if not swept:
        raise SceneError(f"{scene.path.name}: {lidar.name!r} swept in no training frame")
    random = torch.Generator().manual_seed(config.seed)
    most = max(1, min(config.rays_per_sweep, config.most_rays // len(swept)))
    found = []
    for sweep in swept:
        rays = recorded_rays(scene, sweep, lidar)
        found.append(rays.select(torch.randperm(len(rays), generator=random)[:most]))
    return found


SPACING = 0.004
"""Spacing that is asked for, in units of the range: about that of the beams of a dense sensor."""
LEAST_VOXEL_M = 0.05
REACH = 0.5
"""Largest standard deviation within the surface, in voxels."""
THICKNESS = 0.05
"""Standard deviation across the surface, in units of that within it, at least."""


def surfels_of(
    scene: DrivingScene, frames: Collection[int], *, most: int
) -> tuple[GaussianSet, tuple[str, ...]]:
    """Flat Gaussians on what the sweeps of some frames met: the street, each actor in its box.

    A fit to images leaves surfaces a few centimetres thick and lets the far ones float; a LiDAR
    says within two centimetres where they are. So rays meet surfels of the LiDAR map, which stand
    for no image, and the fitted scene's own Gaussians only where nobody swept: of inserted actors.

    Args:
        scene: the log, its poses corrected.
        frames: whose sweeps are read; no other is.
        most: how many surfels there may be.

    Returns:
        The surfels, and the ids of the actors that bodies 1, 2, ... are.
    """
    points = gather_points(scene, frames)
    clouds = [
        Cloud.of(
            part, SPACING * part.range_m, torch.ones(len(part), dtype=torch.bool), LEAST_VOXEL_M
        )
        for part in (points.street, *points.actors.values())
    ]
    sets = [
        surfels_from_points(
            voxels.xyz_m,
            torch.full_like(voxels.xyz_m, 0.5),
            body=body,
            sh_degree=0,
            most_sigma_m=REACH * voxels.size_m,
            least_thickness=THICKNESS,
        )
        for body, voxels in enumerate(adaptive_voxels(clouds, budget=most))
    ]
    return joined_gaussians(sets), tuple(points.actors)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Target:
    """What was measured along rays."""

    range_m: Float[Tensor, " rays"]
    is_returned: Tensor
    intensity: Float[Tensor, " rays"]
    """In [0, 1]."""

    def select(self, rows: Tensor) -> "_Target":
        return _Target(**{name: column[rows] for name, column in vars(self).items()})


@dataclass(frozen=True, eq=False, kw_only=True)
class _Learnt:
    """What is being learnt of surfels, leaves of autograd."""

    surfels: GaussianSet
    opacity_logit: Float[Tensor, " surfels"]
    offset_m: Float[Tensor, " surfels"]
    strength: Float[Tensor, " surfels"]
    drop: Float[Tensor, " surfels"]
    heads: Heads

    @classmethod
    def start(cls, surfels: GaussianSet, seed: int) -> "_Learnt":
        count = len(surfels)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            heads = Heads()
        return cls(
            surfels=surfels,
            opacity_logit=surfels.opacity_logit.clone().requires_grad_(),
            offset_m=torch.zeros(count, requires_grad=True),
            strength=torch.full((count,), FIRST_STRENGTH, requires_grad=True),
            drop=torch.zeros(count, requires_grad=True),
            heads=heads,
        )

    def optimiser(self) -> torch.optim.Optimizer:
        leaves = {
            "opacity": [self.opacity_logit],
            "offset": [self.offset_m],
            "strength": [self.strength],
            "drop": [self.drop],
            "heads": list(self.heads.parameters()),
        }
        groups = [{"params": own, "lr": RATES[name]} for name, own in leaves.items()]
        return torch.optim.Adam(groups)

    def surfels_now(self) -> GaussianSet:
        """The surfels where they are by now, as clear as they are."""
        thin_axes = axes_at(self.surfels.rotation_wxyz, self.surfels.log_scale.argmin(dim=1))
        moved = self.offset_m.detach()[:, None] * thin_axes
        return replace(
            self.surfels,
            means=self.surfels.means + moved,
            opacity_logit=self.opacity_logit.detach().clone(),
        )

    @torch.no_grad()
    def met(
        self, fitted: GaussianScene, placed: Tensor, sweeps: Sequence[SweepRays], most_hits: int
    ) -> RayHits:
        """What the rays of all sweeps meet, offsets left out: those are added with gradient."""
        there = replace(
            self.surfels, body_index=placed, opacity_logit=self.opacity_logit.detach().clone()
        )
        solids = Solids(gaussians=there, channels=torch.zeros(len(there), 0))
        found = [trace_sweep(fitted, solids, one, most_hits=most_hits).hits for one in sweeps]
        return RayHits(*(torch.cat(column) for column in zip(*found, strict=True)))

    @torch.no_grad()
    def carve(self, hits: RayHits, target: _Target) -> None:
        """Let surfels begin clear that more rays went through than ended at."""
        behind_m = (target.range_m[:, None] - hits.range_m) * hits.cosine
        is_there = (hits.row >= 0) & target.is_returned[:, None]
        passed, ended = (
            torch.zeros(len(self.drop)).index_add_(
                0, hits.row.clamp(min=0).flatten(), (hits.response * is_so * is_there).flatten()
            )
            for is_so in (behind_m > PASSED_M, behind_m.abs() <= PASSED_M)
        )
        self.opacity_logit[passed > PASSES * ended] = CLEAR

    def blended(
        self, hits: RayHits
    ) -> tuple[MetSurfaces, Float[Tensor, "rays hits"], Float[Tensor, "rays hits"]]:
        """What rays met, and the weight and range of every answer; differentiable."""
        weight = blended_hits(hits, torch.sigmoid(self.opacity_logit))
        index = hits.row.clamp(min=0)
        slope = hits.slope.clamp(-STEEPEST, STEEPEST)
        range_m = hits.range_m + slope * self.offset_m[index]
        alpha = weight.sum(dim=1)
        share = weight / alpha.clamp(min=1e-4)[:, None]
        met = MetSurfaces(
            range_m=(share * range_m).sum(dim=1),
            alpha=alpha,
            cosine=(share * hits.cosine).sum(dim=1),
            strength=(share * self.strength[index]).sum(dim=1),
            drop=(share * self.drop[index]).sum(dim=1),
        )
        return met, weight, range_m

    def loss(self, hits: RayHits, target: _Target) -> Tensor:
        """How badly some rays are told, and how far surfels have moved."""
        met, weight, range_m = self.blended(hits)
        lost, intensity = self.heads(met)
        away_m = (range_m - target.range_m[:, None]).abs()
        unstopped = torch.log1p(torch.tensor(LOST_M / SOFT_M)) * (1 - met.alpha)
        wrong = (weight * torch.log1p(away_m / SOFT_M)).sum(dim=1) + unstopped
        is_back = target.is_returned.float()
        back = is_back.sum().clamp(min=1)
        dark = (intensity - target.intensity).square() * is_back
        dropped = torch.nn.functional.binary_cross_entropy_with_logits(lost, 1 - is_back)
        moved = (self.offset_m / MOVED_M).square().mean()
        ranges, brightness = (wrong * is_back).sum() / back, dark.sum() / back
        return ranges + INTENSITY_WEIGHT * brightness + dropped + MOVED_WEIGHT * moved

    @torch.no_grad()
    def noise(self, hits: RayHits, target: _Target) -> Float[Tensor, " bands"]:
        """Spread of what was measured around what is told, band by band of range."""
        _, weight, range_m = self.blended(hits)
        half = (weight.cumsum(dim=1) >= 0.5).int().argmax(dim=1, keepdim=True)
        error_m = (range_m.gather(1, half)[:, 0] - target.range_m)[target.is_returned].abs()
        band = torch.bucketize(target.range_m[target.is_returned], torch.tensor(NOISE_EDGES_M[1:]))
        spreads = [error_m[band == row] for row in range(len(NOISE_EDGES_M))]
        usual = error_m.median() if len(error_m) else torch.tensor(0.02)
        # a median of absolute errors is two thirds of a spread; a few errors say nothing
        return 1.48 * torch.stack([one.median() if len(one) > 50 else usual for one in spreads])
