"""Lenses as simulators describe them: where a direction falls, and where a pixel looks to.

Camera frame: x right, y down, z forward. The top-left pixel has its centre at (0.5, 0.5).

- Pinhole: OpenCV's rational model with tangential and thin prism terms.
- Radial: the distance from the principal point is a polynomial of the angle from the axis, or the
  angle one of the distance. OpenCV's fisheye and NVIDIA's f-theta, beyond 180 degrees too.
- Windshield: a glass before any of them turns rays, by polynomials in two variables of the ray's
  horizontal and vertical angle.

What has no inverse in closed form is inverted by Newton's method with a fixed number of steps.
Polynomials count as far as they rise: what lies beyond is outside of the lens.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera

SAMPLES = 2048
"""Places at which a curve is looked at, to find how far it rises and where Newton begins."""
STEPS = 8
"""Of Newton's method at most; from a good start it comes to rest after five."""
AT_REST = 1e-11
"""Moves that are no longer worth a step."""
STEP = 1e-6
"""Over which slopes of functions of two variables are taken."""
EXACT_PX = 1e-3
"""A pixel whose ray falls farther from it than this has no ray."""
STRIP = 2**18
"""Pixels whose rays are found at a time."""
WIDEST_TANGENT = 20.0
"""Of a pinhole: 87 degrees from the axis."""
Plane = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class RisingCurve:
    """A polynomial from 0 to `limit`, as far as it rises there, and its inverse."""

    coefficients: tuple[float, ...]
    """The constant first."""
    limit: float

    def at(self, values: Float[Tensor, "*values"]) -> Float[Tensor, "*values"]:
        """The polynomial by Horner's rule, values beyond its ends taken as there."""
        return _horner(self.coefficients, values.clamp(0, self.end))

    def back(self, results: Float[Tensor, "*values"]) -> Float[Tensor, "*values"]:
        """Where the polynomial takes these values; the nearer end where it does not."""
        places, heights = (each.to(results) for each in self._table)
        after = torch.searchsorted(heights, results.contiguous()).clamp(1, len(heights) - 1)
        low, high = heights[after - 1], heights[after]
        share = ((results - low) / (high - low).clamp(min=1e-30)).clamp(0, 1)
        found = places[after - 1] + share * (places[after] - places[after - 1])
        slope = tuple(i * c for i, c in enumerate(self.coefficients))[1:]
        for _ in range(3):  # from within a two thousandth of the curve
            rate = _horner(slope, found).clamp(min=1e-12)
            found = (found - (_horner(self.coefficients, found) - results) / rate).clamp(
                0, self.end
            )
        return found

    @property
    def end(self) -> float:
        """How far the polynomial rises."""
        return float(self._table[0][-1])

    @cached_property
    def _table(self) -> tuple[Tensor, Tensor]:
        places = torch.linspace(0, self.limit, SAMPLES, dtype=torch.float64)
        heights = _horner(self.coefficients, places)
        falls = (~(heights.diff() > 0)).nonzero()
        count = int(falls[0, 0]) + 1 if len(falls) else SAMPLES
        return places[:count], heights[:count]


def _horner(coefficients: tuple[float, ...], values: Tensor) -> Tensor:
    total = torch.zeros_like(values)
    for coefficient in reversed(coefficients):
        total = total * values + coefficient
    return total


def newton(
    function: Plane, wanted: Float[Tensor, "*points 2"], start: Float[Tensor, "*points 2"]
) -> Float[Tensor, "*points 2"]:
    """Where a function of the plane takes the wanted values, by Newton's method from a start."""
    found, wanted = start.reshape(-1, 2).clone(), wanted.reshape(-1, 2)
    steps = torch.eye(2, dtype=start.dtype, device=start.device) * STEP
    moving = torch.arange(len(found), device=start.device)
    for _ in range(STEPS):
        place = found[moving]
        value = function(place)
        (a, c), (b, d) = (((function(place + step) - value) / STEP).unbind(-1) for step in steps)
        determinant = a * d - b * c
        safe = torch.where(determinant.abs() < 1e-12, 1e-12, determinant)
        x, y = (wanted[moving] - value).unbind(-1)
        move = torch.stack([d * x - b * y, a * y - c * x], dim=-1) / safe[..., None]
        move = move.nan_to_num().clamp(-1, 1)
        found[moving] = place + move
        moving = moving[(move.abs() > AT_REST).any(dim=-1)]
    return found.reshape(start.shape)


@dataclass(frozen=True)
class PinholeLens:
    """OpenCV's model on the plane one focal length ahead."""

    radial: tuple[float, ...] = ()
    """k1 to k6."""
    tangential: tuple[float, ...] = ()
    """p1 and p2."""
    thin_prism: tuple[float, ...] = ()
    """s1 to s4."""

    @property
    def is_plain(self) -> bool:
        """Whether it distorts nothing."""
        return not any((*self.radial, *self.tangential, *self.thin_prism))

    def plane_of(self, directions: Float[Tensor, "*rays 3"]) -> Float[Tensor, "*rays 2"]:
        """Where directions meet the image plane, distorted; those beyond the lens at its edge."""
        ahead = directions[..., 2:].clamp(min=1e-9)
        plane = directions[..., :2] / ahead
        radius = plane.norm(dim=-1, keepdim=True)
        return self._distorted(plane * (self.widest / radius.clamp(min=1e-12)).clamp(max=1))

    def rays_of(
        self, plane: Float[Tensor, "*pixels 2"]
    ) -> tuple[Float[Tensor, "*pixels 3"], Bool[Tensor, "*pixels"]]:
        """Directions of places on the image plane, and whether the lens has one for them."""
        found = plane if self.is_plain else newton(self._distorted, plane, plane)
        within = found.norm(dim=-1) <= self.widest
        return torch.cat([found, torch.ones_like(found[..., :1])], dim=-1), within

    @cached_property
    def widest(self) -> float:
        """Tangent of the widest angle: as far as the radial part moves outwards."""
        radius = torch.linspace(0, WIDEST_TANGENT, SAMPLES, dtype=torch.float64)
        moved = radius * self._factor(radius.square())
        falls = (~(moved.diff() > 0)).nonzero()
        return float(radius[falls[0, 0]]) if len(falls) else WIDEST_TANGENT

    def _factor(self, square: Tensor) -> Tensor:
        k1, k2, k3, k4, k5, k6 = (*self.radial, *[0.0] * 6)[:6]
        below = 1 + square * (k4 + square * (k5 + square * k6))
        return (1 + square * (k1 + square * (k2 + square * k3))) / below

    def _distorted(self, plane: Float[Tensor, "*points 2"]) -> Float[Tensor, "*points 2"]:
        p1, p2 = (*self.tangential, 0.0, 0.0)[:2]
        s1, s2, s3, s4 = (*self.thin_prism, *[0.0] * 4)[:4]
        x, y = plane.unbind(-1)
        square = x * x + y * y
        factor = self._factor(square)
        across = x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x)
        down = y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y
        prism = square * (s1 + s2 * square), square * (s3 + s4 * square)
        return torch.stack([across + prism[0], down + prism[1]], dim=-1)


@dataclass(frozen=True)
class RadialLens:
    """The distance from the middle follows the angle from the axis, or the angle the distance."""

    curve: RisingCurve
    is_of_angle: bool
    """Whether the curve gives the distance of an angle, or the angle of a distance."""
    max_angle_rad: float

    @property
    def is_plain(self) -> bool:
        """Whether it is a pinhole: never."""
        return False

    def plane_of(self, directions: Float[Tensor, "*rays 3"]) -> Float[Tensor, "*rays 2"]:
        """Where directions fall; those beyond the lens at its edge."""
        aside = directions[..., :2].norm(dim=-1)
        angle = torch.atan2(aside, directions[..., 2]).clamp(max=self.widest_rad)
        distance = self.curve.at(angle) if self.is_of_angle else self.curve.back(angle)
        return directions[..., :2] * (distance / aside.clamp(min=1e-12))[..., None]

    def rays_of(
        self, plane: Float[Tensor, "*pixels 2"]
    ) -> tuple[Float[Tensor, "*pixels 3"], Bool[Tensor, "*pixels"]]:
        """Directions of places on the image plane, and whether the lens has one for them."""
        distance = plane.norm(dim=-1)
        angle = self.curve.back(distance) if self.is_of_angle else self.curve.at(distance)
        reached = self.curve.at(angle) if self.is_of_angle else self.curve.back(angle)
        within = ((reached - distance).abs() < 1e-6 * (1 + distance)) & (angle <= self.widest_rad)
        aside = plane * (angle.sin() / distance.clamp(min=1e-12))[..., None]
        return torch.cat([aside, angle.cos()[..., None]], dim=-1), within

    @cached_property
    def widest_rad(self) -> float:
        """The widest angle from the axis: that of the description, or where the curve ends."""
        end = self.curve.end
        reach = (
            end if self.is_of_angle else float(_horner(self.curve.coefficients, torch.tensor(end)))
        )
        return min(self.max_angle_rad, reach, math.pi)


@dataclass(frozen=True)
class Windshield:
    """A glass before the lens: polynomials of the horizontal and vertical angle of a ray.

    Rows of coefficients go by rising power of the vertical angle, each by rising power of the
    horizontal one; an order n has n + 1, n, ... 1 of them.
    """

    horizontal: tuple[float, ...]
    vertical: tuple[float, ...]
    is_forward: bool
    """Whether the polynomials turn rays of the world into rays at the lens, or these back."""

    def at_lens(self, directions: Float[Tensor, "*rays 3"]) -> Float[Tensor, "*rays 3"]:
        """Directions behind the glass of directions in the world."""
        return self._turned(directions, is_given=self.is_forward)

    def in_world(self, directions: Float[Tensor, "*rays 3"]) -> Float[Tensor, "*rays 3"]:
        """Directions in the world of directions behind the glass."""
        return self._turned(directions, is_given=not self.is_forward)

    def _turned(self, directions: Tensor, *, is_given: bool) -> Tensor:
        unit = torch.nn.functional.normalize(directions, dim=-1)
        angles = unit[..., :2].clamp(-1, 1).asin()
        found = self._polynomials(angles) if is_given else newton(self._polynomials, angles, angles)
        aside = found.sin()
        ahead = (1 - aside.square().sum(-1)).clamp(min=0).sqrt() * unit[..., 2].sign()
        return torch.cat([aside, ahead[..., None]], dim=-1)

    def _polynomials(self, angles: Float[Tensor, "*rays 2"]) -> Float[Tensor, "*rays 2"]:
        across, down = angles.unbind(-1)
        return torch.stack(
            [_of_two(own, across, down) for own in (self.horizontal, self.vertical)], dim=-1
        )


def _of_two(coefficients: tuple[float, ...], x: Tensor, y: Tensor) -> Tensor:
    count = round((math.sqrt(8 * len(coefficients) + 1) - 1) / 2)
    rows, start = [], 0
    for length in range(count, 0, -1):
        rows.append(coefficients[start : start + length])
        start += length
    total = torch.zeros_like(x)
    for row in reversed(rows):
        total = total * y + _horner(row, x)
    return total


@dataclass(frozen=True, kw_only=True)
class SensorCamera:
    """A lens before an image of a size."""

    lens: PinholeLens | RadialLens
    pixels_per_unit: tuple[float, float, float, float]
    """The matrix (row by row) that takes the lens' plane to pixels."""
    middle_px: tuple[float, float]
    """The principal point, from the left and the upper edge."""
    width_px: int
    height_px: int
    windshield: Windshield | None = None

    @classmethod
    def of_pinhole(cls, camera: Camera) -> "SensorCamera":
        """A pinhole that distorts nothing."""
        return cls(
            lens=PinholeLens(),
            pixels_per_unit=(camera.fx_px, 0.0, 0.0, camera.fy_px),
            middle_px=(camera.cx_px, camera.cy_px),
            width_px=camera.width_px,
            height_px=camera.height_px,
        )

    def resized(self, width_px: int, height_px: int) -> "SensorCamera":
        """The same view on another grid (edges of the image stay aligned)."""
        across, down = width_px / self.width_px, height_px / self.height_px
        a, b, c, d = self.pixels_per_unit
        return replace(
            self,
            pixels_per_unit=(across * a, across * b, down * c, down * d),
            middle_px=(across * self.middle_px[0], down * self.middle_px[1]),
            width_px=width_px,
            height_px=height_px,
        )

    @property
    def is_searched(self) -> bool:
        """Whether every ray is searched for: there is no formula for it."""
        bends = isinstance(self.lens, PinholeLens) and not self.lens.is_plain
        return bends or self.windshield is not None

    def pinhole_at(self, world_from_camera: Float[Tensor, "4 4"]) -> Camera | None:
        """The same as a pinhole without distortion; None if it is none."""
        if not self.lens.is_plain or self.windshield is not None:
            return None
        return Camera(
            world_from_camera=world_from_camera,
            fx_px=self.pixels_per_unit[0],
            fy_px=self.pixels_per_unit[3],
            cx_px=self.middle_px[0],
            cy_px=self.middle_px[1],
            width_px=self.width_px,
            height_px=self.height_px,
        )

    def project(self, directions: Float[Tensor, "*rays 3"]) -> Float[Tensor, "*rays 2"]:
        """Pixels on which directions of the camera's frame fall; beyond the lens, its edge."""
        seen = directions if self.windshield is None else self.windshield.at_lens(directions)
        plane = self.lens.plane_of(seen)
        return plane @ self._matrix.to(plane).T + plane.new_tensor(self.middle_px)

    def pixel_rays(self) -> tuple[Float[Tensor, "height width 3"], Bool[Tensor, "height width"]]:
        """Unit directions (float64) through the centres of pixels, and whether there is one.

        Each ray is checked: it falls on its pixel again.
        """
        rows = max(STRIP // self.width_px, 1)
        strips = [
            self._rays_of_rows(first, min(first + rows, self.height_px))
            for first in range(0, self.height_px, rows)
        ]
        rays, is_seen = zip(*strips, strict=True)
        return torch.cat(rays), torch.cat(is_seen)

    def _rays_of_rows(
        self, first: int, last: int
    ) -> tuple[Float[Tensor, "rows width 3"], Bool[Tensor, "rows width"]]:
        down = torch.arange(first, last, dtype=torch.float64) + 0.5
        across = torch.arange(self.width_px, dtype=torch.float64) + 0.5
        grid = torch.stack(torch.meshgrid(across, down, indexing="xy"), dim=-1)
        inverse = torch.linalg.inv(self._matrix)
        seen, within = self.lens.rays_of((grid - grid.new_tensor(self.middle_px)) @ inverse.T)
        rays = seen if self.windshield is None else self.windshield.in_world(seen)
        rays = torch.nn.functional.normalize(rays, dim=-1)
        missed = (self.project(rays) - grid).norm(dim=-1)
        return rays, within & (missed < EXACT_PX)

    @property
    def _matrix(self) -> Float[Tensor, "2 2"]:
        return torch.tensor(self.pixels_per_unit, dtype=torch.float64).reshape(2, 2)
