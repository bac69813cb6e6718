"""Light of Gaussians with numba: one Gaussian at a time, those out of view left dark."""

# ruff: noqa: ANN001, ANN202 - numba infers these types

import math
from typing import Any, NamedTuple, TypeVar

import numba
import numpy as np
import torch
from torch import Tensor

from lidarpainter_models.kernels import scene_light
from lidarpainter_models.kernels.frustum_culling import Frustum
from lidarpainter_models.kernels.gaussian_raster.blending_limits import NEAR_M
from lidarpainter_models.kernels.side_by_side import kernels_to_oneself
from lidarpainter_models.weather import darkness, water
from lidarpainter_models.weather.light import to_display

RUNS = 64  # in which Gaussians are shared out, whatever the number of threads
STEPS = 2048
_ROOTS = torch.linspace(0, 1, STEPS + 1)[:, None].expand(-1, 3)
CURVE = to_display(_ROOTS**2)[:, 0].numpy().copy()
"""Displayed brightness by the root of light, in equal steps."""
_FAST = {"contract", "arcp", "nsz", "afn", "reassoc"}  # infinities keep their meaning
_CACHED: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": _FAST}
_COMPILED = _CACHED | {"error_model": "numpy"}
_INNER = _COMPILED | {"forceinline": True}  # calls would pass every array's parts one by one

# single precision throughout: a double constant would turn all that it meets to doubles
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_NEAR_M = np.float32(NEAR_M)
_NEAREST_M2 = np.float32(darkness.NEAREST_M2)
_BEAM_CUT = np.float32(darkness.BEAM_CUT_RAD)
_PER_DOWN = np.float32(1 / darkness.BEAM_DOWN_RAD)
_PER_EDGE = np.float32(1 / darkness.BEAM_EDGE_RAD)
_PER_ACROSS = np.float32(1 / darkness.BEAM_ACROSS_RAD)
_STRAY = np.float32(darkness.STRAY_LIGHT)
_WIDEST_BEAM = np.float32(scene_light.WIDEST_BEAM)
_FAINT = np.float32(scene_light.FAINT)
_PER_STRAY_M2 = np.float32(1 / scene_light.STRAY_REACH_M**2)
_WATER = np.float32(water.WATER_REFLECTANCE)
_PER_TURN = np.float32(1 / (2 * math.pi))
_PER_SOFTNESS = np.float32(1 / scene_light.SKYLINE_SOFTNESS)
_MOST_GAIN = np.float32(scene_light.MOST_GAIN)
_PER_SH = np.float32(1 / scene_light.SH_CONSTANT)
_SMALL_M, _LEAST_LEVEL_M, _DARK = np.float32(1e-3), np.float32(0.1), np.float32(1e-6)

Part = TypeVar("Part", scene_light.Surfaces, scene_light.Appearance, scene_light.Surroundings)


class _Lamps(NamedTuple):
    position: np.ndarray
    heading: np.ndarray
    power: np.ndarray
    reach_m: np.ndarray
    of_bodies: np.ndarray
    starts: np.ndarray
    """Lamps that may reach body b are those of_bodies[starts[b] : starts[b + 1]]."""


def irradiance(
    surfaces: scene_light.Surfaces, world_from_body: Tensor, lamps: scene_light.Lamps
) -> Tensor:
    """See `scene_light.irradiance`."""
    found = np.zeros((len(surfaces.means), 3), np.float32)
    with kernels_to_oneself():
        every = torch.ones(len(world_from_body), len(lamps.reach_m))
        _irradiance(_arrays(surfaces), _array(world_from_body), _lamps(lamps, every > 0), found)
    return torch.from_numpy(found)


def seen_harmonics(
    surfaces: scene_light.Surfaces,
    appearance: scene_light.Appearance,
    surroundings: scene_light.Surroundings,
    lamps: scene_light.Lamps,
    frustum: Frustum | None,
    world_from_body: Tensor,
    camera_from_body: Tensor,
) -> Tensor:
    """See `scene_light.seen_harmonics`."""
    count, rest = appearance.harmonics.shape[:2]
    found = np.empty((count, 1 + rest, 3), np.float32)
    with kernels_to_oneself():
        _seen_harmonics(
            _arrays(surfaces),
            _array(world_from_body),
            _arrays(appearance),
            _arrays(surroundings),
            _lamps(lamps, scene_light.lamps_that_reach(surfaces, world_from_body, lamps)),
            _sides(frustum),
            _array(camera_from_body),
            found,
        )
    return torch.from_numpy(found)


def _sides(frustum: Frustum | None) -> np.ndarray:
    """Rows of lowest, highest and stretch; none where everything is in view."""
    if frustum is None:
        return np.empty((0, 2), np.float32)
    return np.array((frustum.lowest, frustum.highest, frustum.stretch), np.float32)


def _array(tensor: Tensor) -> np.ndarray:
    """Float32, or int32 where it counts something."""
    dtype = torch.float32 if tensor.is_floating_point() else torch.int32
    return tensor.detach().to(dtype).contiguous().numpy()


def _arrays(part: Part) -> Part:
    """The same named tuple of arrays, as compiled code takes it."""
    values: list[Any] = [
        _array(value) if isinstance(value, Tensor) else np.float32(value) for value in part
    ]
    return type(part)(*values)


def _lamps(lamps: scene_light.Lamps, counts: Tensor) -> _Lamps:
    """Lamps, and those that count for each body."""
    starts = torch.nn.functional.pad(counts.sum(dim=1).cumsum(0), (1, 0))
    return _Lamps(
        _array(lamps.position_world),
        _array(lamps.heading_world),
        _array(lamps.power_rgb),
        _array(lamps.reach_m),
        _array(counts.nonzero()[:, 1]),
        _array(starts),
    )


@numba.njit(**_INNER)
def _turned(pose, row, v):
    return pose[row, 0] * v[0] + pose[row, 1] * v[1] + pose[row, 2] * v[2]


@numba.njit(**_INNER)
def _beam(aside, up, squared):
    """Share of a dipped beam by tangents to its axis; see `weather.darkness.dipped_beam`."""
    level = -_HALF * (aside * _PER_ACROSS) ** 2
    below = _BEAM_CUT - up
    if below > _ZERO:
        return math.exp(level - below * _PER_DOWN)
    edge = -below * _PER_EDGE
    stray = _STRAY * max(_ONE - squared * _PER_STRAY_M2, _ZERO)
    if edge > _FAINT:
        return stray * math.exp(level) if stray > _ZERO else _ZERO
    return math.exp(level) * (stray + (_ONE - stray) * math.exp(-_HALF * edge * edge))


@numba.njit(**_INNER)
def _facing(surfaces, i, pose, x, y, z, away_m):
    """Share of a lamp's light that a surface sends back, seen from the lamp along (x, y, z)."""
    normal = surfaces.normals[i]
    nx, ny, nz = _turned(pose, 0, normal), _turned(pose, 1, normal), _turned(pose, 2, normal)
    cosine = abs(nx * x + ny * y + nz * z) / max(away_m, _SMALL_M)
    cosine += _HALF * (_ONE - math.sqrt(nx * nx + ny * ny + nz * nz))
    least = surfaces.least_facing[i]
    return least + (surfaces.facing[i] - least) * min(max(cosine, _ZERO), _ONE)


@numba.njit(**_INNER)
def _lamp_share(lamps, j, x, y, z, squared):
    """What a lamp throws onto a surface that faces it; 0 beyond its reach and its beam."""
    fade = _ONE - squared / (lamps.reach_m[j] * lamps.reach_m[j])
    if fade <= _ZERO:
        return _ZERO
    along_x, along_y = lamps.heading[j, 0], lamps.heading[j, 1]
    beam = _ONE
    if along_x != _ZERO or along_y != _ZERO:
        ahead, across = x * along_x + y * along_y, y * along_x - x * along_y
        level = max(ahead, _LEAST_LEVEL_M)
        if not ahead > _ZERO or abs(across) > _WIDEST_BEAM * level:
            return _ZERO
        beam = _beam(across / level, z / level, squared)
    return beam * fade * fade / (squared + _NEAREST_M2)


@numba.njit(**_INNER)
def _add_lamps(surfaces, world_from_body, i, lamps, sums):
    """Add the irradiance of the lamps to sums, as far as the surface sends it back."""
    body = surfaces.body_index[i]
    pose = world_from_body[body]
    mean = surfaces.means[i]
    px = _turned(pose, 0, mean) + pose[0, 3]
    py = _turned(pose, 1, mean) + pose[1, 3]
    pz = _turned(pose, 2, mean) + pose[2, 3]
    for place in range(lamps.starts[body], lamps.starts[body + 1]):
        j = lamps.of_bodies[place]
        x, y, z = px - lamps.position[j, 0], py - lamps.position[j, 1], pz - lamps.position[j, 2]
        squared = x * x + y * y + z * z
        share = _lamp_share(lamps, j, x, y, z, squared)
        if share > _ZERO:
            share *= _facing(surfaces, i, pose, x, y, z, math.sqrt(squared))
            for c in range(3):
                sums[c] += share * lamps.power[j, c]


@numba.njit(**_COMPILED, parallel=True)
def _irradiance(surfaces, world_from_body, lamps, found):
    for i in numba.prange(len(surfaces.means)):
        _add_lamps(surfaces, world_from_body, i, lamps, found[i])


@numba.njit(**_INNER)
def _skyline_at(around, place, x, y):
    """Row of the skyline's table before a direction, the one after, and the later one's weight."""
    sectors = around.skylines.shape[1]
    turn = math.atan2(y, x) * _PER_TURN
    turn = (turn - math.floor(turn)) * np.float32(sectors)
    first = int(turn)
    before = around.skylines[place, first % sectors]
    after = around.skylines[place, (first + 1) % sectors]
    return before, after, turn - np.float32(first)


@numba.njit(**_INNER)
def _mirror(own, around, i, x, y, z, light):
    """Turn light into that with what wet ground mirrors along a view of it."""
    slope = max(-z, _ZERO) / max(math.sqrt(x * x + y * y), _SMALL_M)
    grazing = _ONE - slope / math.sqrt(_ONE + slope * slope)
    shine = own.shine[i] * (_WATER + (_ONE - _WATER) * grazing**5)
    place = own.skyline[i]
    if place < 0:
        for c in range(3):
            light[c] += shine * (around.sky_light[c] - light[c])
        return
    before, after, weight = _skyline_at(around, place, x, y)
    height = before[3] + weight * (after[3] - before[3])
    over = min(max((slope - height) * _PER_SOFTNESS + _HALF, _ZERO), _ONE)
    for c in range(3):
        seen = before[c] + weight * (after[c] - before[c])
        seen += over * (around.sky_light[c] - seen)
        light[c] += shine * (seen - light[c])


@numba.njit(**_INNER)
def _is_in_view(point, reach_m, sides):
    """Whether a Gaussian may be seen; `sides` are rows of lowest, highest and stretch."""
    if len(sides) == 0:
        return True
    if not point[2] >= _NEAR_M:
        return False
    for axis in range(2):
        most = reach_m * sides[2, axis]
        above = point[axis] - sides[1, axis] * point[2]
        if max(above, sides[0, axis] * point[2] - point[axis]) > most:
            return False
    return True


@numba.njit(**_INNER)
def _display(light):
    """Read `weather.light.to_display` off a table by the root of light."""
    place = math.sqrt(min(max(light, _ZERO), _ONE)) * np.float32(STEPS)
    before = min(int(place), STEPS - 1)
    return CURVE[before] + (place - np.float32(before)) * (CURVE[before + 1] - CURVE[before])


@numba.njit(**_INNER)
def _write(own, around, i, distance_m, light, shown, found):
    """Harmonics of a surface that sends out light and shows `shown` before the air takes part."""
    through = math.exp(-around.extinction_per_m * distance_m)
    rest = found.shape[1] - 1
    for c in range(3):
        seen = shown[c] * through + around.airlight[c] * (_ONE - through)
        rgb = _display(seen)
        share = min(through * light[c] / max(seen, _DARK), _ONE)
        gain = min(share * rgb * own.per_base[i, c], _MOST_GAIN)
        found[i, 0, c] = (rgb - _HALF) * _PER_SH
        for k in range(rest):
            found[i, 1 + k, c] = gain * own.harmonics[i, k, c]


@numba.njit(**_INNER)
def _see(  # noqa: PLR0913 - all that a surface's colour hangs on
    surfaces, world_from_body, own, around, lamps, i, camera_from_body, point, scratch, found
):
    """Write the harmonics of a surface that lies at a point in the camera frame."""
    light, shown = scratch[0], scratch[1]
    light[0] = light[1] = light[2] = _ZERO
    if len(lamps.of_bodies):
        _add_lamps(surfaces, world_from_body, i, lamps, light)
    for c in range(3):
        light[c] = own.light[i, c] + own.reflectance[i, c] * light[c]
        shown[c] = light[c]
    if own.shine[i] > 0.0:
        back, world = camera_from_body[0].T, world_from_body[0]
        in_street = (_turned(back, 0, point), _turned(back, 1, point), _turned(back, 2, point))
        x, y = _turned(world, 0, in_street), _turned(world, 1, in_street)
        _mirror(own, around, i, x, y, _turned(world, 2, in_street), shown)
    distance_m = math.sqrt(point[0] * point[0] + point[1] * point[1] + point[2] * point[2])
    _write(own, around, i, distance_m, light, shown, found)


@numba.njit(**_COMPILED, parallel=True)
def _seen_harmonics(  # noqa: PLR0913 - as `_see`
    surfaces, world_from_body, own, around, lamps, sides, camera_from_body, found
):
    count = len(surfaces.means)
    for run in numba.prange(RUNS):
        scratch = np.empty((2, 3), np.float32)
        for i in range(run * count // RUNS, (run + 1) * count // RUNS):
            pose, mean = camera_from_body[surfaces.body_index[i]], surfaces.means[i]
            point = (
                _turned(pose, 0, mean) + pose[0, 3],
                _turned(pose, 1, mean) + pose[1, 3],
                _turned(pose, 2, mean) + pose[2, 3],
            )
            if _is_in_view(point, surfaces.reach_m[i], sides):
                _see(
                    surfaces,
                    world_from_body,
                    own,
                    around,
                    lamps,
                    i,
                    camera_from_body,
                    point,
                    scratch,
                    found,
                )
            else:
                found[i] = _ZERO
