"""How well simulated sweeps agree with held-out ones, as neurad-studio judges them and as we do.

neurad-studio (Tonderski et al., NeuRAD, 2024): over the rays of a sweep, the median of the squared
error of the range and the root of the mean squared error of intensity where something came back;
the part of rays of which it is right whether anything did, at a chance of one half; and the squared
Chamfer distance between the points that are told and those measured, both ways, over the number
measured. Our own figures are absolute errors: by range, on what stands and on what moves, inside
the boxes of each category, and where the next ray of a beam ends at another distance.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.lidar_returns.channel import LidarChannel, SimulatedSweep
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.lidar.firings import MountedLidar, SweepRays, recorded_rays
from lidarpainter_models.lidar.points_on_actors import BACKGROUND, MovingBoxes
from lidarpainter_models.scenes.categories import category_of
from lidarpainter_models.scenes.driving_scene import DrivingScene

BANDS_M = (0.0, 10.0, 20.0, 40.0, 80.0, 1000.0)
LEFT_OUT = {"pandar64": (62, 63)}
"""Beams, counted from 0, that neurad-studio leaves out: they meet the car that carries them."""
LEAST_RAYS = 200
"""A figure of fewer rays than that over all sweeps is none."""
JUMP_M, JUMP_SHARE, NEXT_DEG = 0.5, 0.05, 1.0
"""Rays of a beam so near in azimuth whose ranges part by more, in metres and of the nearer one, lie
on both sides of a silhouette."""
TOGETHER_NS = 5_000_000
"""Points that were measured so near in time are looked at in the same boxes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LidarEvaluation:
    """The held-out sweeps of one LiDAR."""

    scene: DrivingScene
    """Its poses as the fit corrected them."""
    lidar: MountedLidar
    test_frames: tuple[int, ...]

    def scores(
        self,
        channel: LidarChannel,
        fitted: GaussianScene,
        progress: Callable[[int, int], None] = lambda _done, _total: None,
    ) -> dict[str, Any]:
        """Figures of `neurad-studio`'s protocol and of our own.

        Raises:
            ConfigError: no sweep was held out.
        """
        swept = (one for one in self.scene.sweeps if one.frame_index in self.test_frames)
        sweeps = [sweep for sweep in swept if sweep.lidar_name == self.lidar.name]
        if not sweeps:
            raise ConfigError(
                f"{self.scene.path.name}: no sweep of {self.lidar.name!r} was held out to judge by"
            )
        boxes = MovingBoxes(self.scene.tracks)
        judged = []
        for done, sweep in enumerate(sweeps, start=1):
            rays = recorded_rays(self.scene, sweep, self.lidar)
            left_out = torch.tensor(LEFT_OUT.get(self.lidar.sensor.name, ()), dtype=torch.int64)
            rays = rays.select((~torch.isin(rays.beam, left_out)).nonzero()[:, 0])
            told = channel.simulated(fitted, rays)
            judged.append(_Judged.of(rays, told, boxes, channel.full_intensity))
            progress(done, len(sweeps))
        by_protocol = _by_protocol(judged)
        if not self.lidar.tells_lost:
            by_protocol["ray_drop_accuracy"] = None
        return {
            "neurad-studio": by_protocol,
            "own": dict(_own(judged, boxes)),
            "lidar": self.lidar.name,
            "num_sweeps": len(sweeps),
            "num_rays": sum(len(one.is_returned) for one in judged),
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class _Judged:
    """One sweep, ray by ray."""

    error_m: Float[Tensor, " rays"]
    """Range told less range measured; of rays that came back."""
    range_m: Float[Tensor, " rays"]
    """As measured, 0 of rays that did not."""
    intensity_error: Float[Tensor, " rays"]
    """In [-1, 1]."""
    is_returned: Bool[Tensor, " rays"]
    is_told: Bool[Tensor, " rays"]
    """Whether a return was told."""
    owner: Int[Tensor, " rays"]
    """Track whose box it came back from, or `BACKGROUND`."""
    is_outline: Bool[Tensor, " rays"]
    """Whether it came back beside a silhouette."""
    chamfer_m2: float

    @classmethod
    def of(
        cls, rays: SweepRays, told: SimulatedSweep, boxes: MovingBoxes, full_intensity: float
    ) -> "_Judged":
        measured_m = (rays.origin_m + rays.range_m[:, None] * rays.direction)[rays.is_returned]
        told_m = rays.origin_m + told.range_m.double()[:, None] * rays.direction
        return cls(
            error_m=told.range_m - rays.range_m.float(),
            range_m=rays.range_m.float(),
            intensity_error=(told.intensity - rays.intensity) / full_intensity,
            is_returned=rays.is_returned,
            is_told=told.is_returned,
            owner=_owners(rays, boxes),
            is_outline=_outlines(rays),
            chamfer_m2=chamfer_m2(told_m[told.is_returned], measured_m),
        )


def chamfer_m2(told_m: Float[Tensor, "told 3"], measured_m: Float[Tensor, "measured 3"]) -> float:
    """Squared distances to the nearest of the others, both ways, over the number measured."""
    if not len(told_m) or not len(measured_m):
        return float("nan")
    first, second = told_m.numpy(), measured_m.numpy()
    there = cKDTree(second).query(first)[0]
    back = cKDTree(first).query(second)[0]
    return float((np.square(there).sum() + np.square(back).sum()) / len(second))


def _owners(rays: SweepRays, boxes: MovingBoxes) -> Int[Tensor, " rays"]:
    """The track whose box each ray has come back from, or `BACKGROUND`."""
    found = torch.full((len(rays),), BACKGROUND)
    back = rays.is_returned.nonzero()[:, 0]
    points_m = (rays.origin_m + rays.range_m[:, None] * rays.direction)[back].float()
    since = rays.time_ns[back] // TOGETHER_NS
    for part in torch.unique(since).tolist():
        own = (since == part).nonzero()[:, 0]
        middle_ns = part * TOGETHER_NS + TOGETHER_NS // 2
        found[back[own]] = boxes.owners(points_m[own], middle_ns).to(found)
    return found


def _outlines(rays: SweepRays) -> Bool[Tensor, " rays"]:
    """Which rays have come back from either side of a silhouette, as far as beams are known."""
    azimuth_deg = torch.rad2deg(torch.atan2(rays.direction[:, 1], rays.direction[:, 0]))
    order = torch.from_numpy(np.lexsort((azimuth_deg.numpy(), rays.beam.numpy())))
    beam, range_m = rays.beam[order], rays.range_m[order]
    nearer_m = torch.minimum(range_m[1:], range_m[:-1])
    is_edge = range_m.diff().abs() > torch.clamp(JUMP_SHARE * nearer_m, min=JUMP_M)
    is_edge &= (beam[1:] == beam[:-1]) & (beam[1:] >= 0) & (nearer_m > 0)
    is_edge &= azimuth_deg[order].diff() < NEXT_DEG
    found = torch.zeros(len(rays), dtype=torch.bool)
    found[order[1:][is_edge]] = True
    found[order[:-1][is_edge]] = True
    return found


def _by_protocol(judged: list[_Judged]) -> dict[str, float | None]:
    """Means over sweeps of each sweep's figures."""
    rows = []
    for one in judged:
        back = one.is_returned
        rows.append(
            {
                "median_squared_depth_m2": float(one.error_m[back].square().median()),
                "intensity_rmse": float(one.intensity_error[back].square().mean().sqrt()),
                "ray_drop_accuracy": float((one.is_told == back).float().mean()),
                "chamfer_m2": one.chamfer_m2,
            }
        )
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _own(judged: list[_Judged], boxes: MovingBoxes) -> Iterator[tuple[str, float | None]]:
    """Median absolute errors over all rays that came back, some of them apart."""
    back = torch.cat([one.is_returned for one in judged])
    error_m = torch.cat([one.error_m for one in judged])[back].abs()
    range_m = torch.cat([one.range_m for one in judged])[back]
    owner = torch.cat([one.owner for one in judged])[back]
    moves = torch.tensor([*(track.is_moving for track in boxes.tracks), False])  # the street last
    yield "median_error_m", _median(error_m, torch.ones_like(range_m, dtype=torch.bool))
    yield "median_error_static_m", _median(error_m, ~moves[owner])
    yield "median_error_moving_m", _median(error_m, moves[owner])
    is_outline = torch.cat([one.is_outline for one in judged])[back]
    yield "median_error_silhouette_m", _median(error_m, is_outline)
    for low, high in pairwise(BANDS_M):
        name = f"median_error_{low:.0f}_{high:.0f}m" if high < 1000 else f"median_error_{low:.0f}m"
        yield name, _median(error_m, (range_m >= low) & (range_m < high))
    classes = [category_of(track.category) for track in boxes.tracks]
    for name in sorted(set(classes)):
        is_of = torch.tensor([*(one == name for one in classes), False])[owner]
        if int(is_of.sum()) >= LEAST_RAYS:
            yield f"median_error_{name.replace(' ', '_')}_m", _median(error_m, is_of)
    yield "within_10_cm", float((error_m <= 0.1).float().mean()) if len(error_m) else None
    yield "told_where_measured", _share(judged, of_returned=True)
    yield "told_where_lost", _share(judged, of_returned=False)


def _median(error_m: Float[Tensor, " rays"], rows: Bool[Tensor, " rays"]) -> float | None:
    found = error_m[rows]
    return float(found.median()) if len(found) >= LEAST_RAYS else None


def _share(judged: list[_Judged], *, of_returned: bool) -> float | None:
    """Of the rays that came back, or did not, the part that is told to come back."""
    told = torch.cat([one.is_told[one.is_returned == of_returned] for one in judged])
    return float(told.float().mean()) if len(told) else None
