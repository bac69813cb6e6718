"""Faults of LiDAR: fewer beams, less range, lost and made-up returns."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.scenes.frame_content import SourceSweep
from lidarpainter_models.scenes.records import SweepPoints
from lidarpainter_models.stress.frames import Frame
from lidarpainter_models.weather.water import DROPS_RETURN_M


def beams(frame: Frame, level: float, _dice: np.random.Generator) -> Frame:
    """So many of the lasers are left, evenly spread; 0 is a car without LiDAR.

    Where rings are not known they are told by elevation, as a sensor of 64 has them.
    """
    if level == 0:
        return replace(frame, sweeps=())
    return _each(frame, lambda sweep: kept(sweep, _beam_mask(sweep, int(level))))


def reach(frame: Frame, level: float, _dice: np.random.Generator) -> Frame:
    """Nothing returns from beyond so many metres."""
    return _each(frame, lambda sweep: kept(sweep, _own_points(sweep).norm(dim=1) <= level))


def dropout(frame: Frame, level: float, dice: np.random.Generator) -> Frame:
    """A share of the returns is lost."""
    return _each(frame, lambda sweep: kept(sweep, _drawn(sweep, dice) >= level))


def clutter(frame: Frame, level: float, dice: np.random.Generator) -> Frame:
    """A share of the returns come from drops in the air before what the beam would meet."""

    def rained(sweep: SourceSweep) -> SourceSweep:
        own = _own_points(sweep)
        away_m = own.norm(dim=1).clamp_min(1e-3)
        nearest_m = torch.minimum(away_m, torch.full_like(away_m, DROPS_RETURN_M))
        stop_m = nearest_m * _drawn(sweep, dice)
        is_drop = _drawn(sweep, dice) < level
        share = torch.where(is_drop, stop_m / away_m, torch.ones_like(away_m))
        world = transform_points(sweep.world_from_lidar, own * share[:, None])
        return replace(sweep, points=replace(sweep.points, xyz_m=world.float()))

    return _each(frame, rained)


def _each(frame: Frame, change: Callable[[SourceSweep], SourceSweep]) -> Frame:
    """All sweeps changed; those that are left without points go."""
    changed = map(change, frame.sweeps)
    return replace(frame, sweeps=tuple(sweep for sweep in changed if len(sweep.points.xyz_m)))


def kept(sweep: SourceSweep, is_kept: torch.Tensor) -> SourceSweep:
    """The points of a mask alone."""
    names = SweepPoints.__dataclass_fields__
    points = SweepPoints(**{name: getattr(sweep.points, name)[is_kept] for name in names})
    semantics = None if sweep.semantics is None else sweep.semantics[is_kept]
    return replace(sweep, points=points, semantics=semantics)


def _own_points(sweep: SourceSweep) -> torch.Tensor:
    """Points in the frame of the sensor, float64."""
    lidar_from_world = invert_rigid(sweep.world_from_lidar)
    return transform_points(lidar_from_world, sweep.points.xyz_m.double())


def _drawn(sweep: SourceSweep, dice: np.random.Generator) -> torch.Tensor:
    """A number from 0 to 1 for each point."""
    return torch.from_numpy(dice.uniform(0, 1, sweep.points.num_points))


def _beam_mask(sweep: SourceSweep, count: int) -> torch.Tensor:
    rings = sweep.points.ring.long()
    if len(rings) == 0:
        return torch.zeros(0, dtype=torch.bool)
    if int(rings.min()) < 0 or len(rings.unique()) == 1:
        own = _own_points(sweep)
        elevation = torch.atan2(own[:, 2], own[:, :2].norm(dim=1))
        rings = torch.bucketize(elevation, torch.quantile(elevation[::97], _LEVELS))
    known = rings.unique()
    chosen = known[torch.linspace(0, len(known) - 1, min(count, len(known))).round().long()]
    return torch.isin(rings, chosen)


_LEVELS = torch.linspace(0, 1, 65, dtype=torch.float64)[1:-1]
