"""Images of any lens, resampled from pinhole images that are finer than it.

A pinhole image shows exactly what lies in the direction of each of its points, so a distorted image
is exact where it is sampled along the rays of its own pixels. A lens narrower than `ONE_FACE_RAD`
takes one pinhole image along its axis; a wider one those faces of a cube around it that its rays
meet, each cut to the part they meet. Where a shutter rolls, Gaussians are moved to when the
distorted image reads them, before any face is drawn.

Camera frames: x right, y down, z forward.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.gaussians.model.rolling_shutter import bodies_apart
from lidarpainter_models.gaussians.model.scene_rendering import PosedScene, gaussians_at
from lidarpainter_models.gaussians.model.seen_gaussians import AnyGaussians
from lidarpainter_models.gaussians.model.spatial_blocks import View
from lidarpainter_models.geometry.cameras import Camera, Shutter
from lidarpainter_models.kernels.row_motion.reference import ReadingTimes, motion_by_times
from lidarpainter_models.serving.lens_models import SensorCamera

ONE_FACE_RAD = math.radians(55)
"""Half of 110 degrees: beyond it one pinhole image has too many pixels at its rim."""
DENSITY = 1.1
"""Pixels of a face per pixel of the lens where the lens is finest, along one axis."""
MOST_PIXELS = 4.0
"""Pixels of all faces together per pixel of the image; beyond it faces are coarser."""
MOST_TIMES = 4
"""A face is drawn up to so many times finer, along one axis, than the lens."""
MARGIN_PX = 4
"""Around what rays meet of a face: resampling looks at neighbours."""
Rows = tuple[tuple[int, int, int], ...]
_CUBE: dict[tuple[int, int], Rows] = {
    (2, 1): ((1, 0, 0), (0, 1, 0), (0, 0, 1)),  # ahead
    (0, 1): ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),  # right
    (0, -1): ((0, 0, -1), (0, 1, 0), (1, 0, 0)),  # left
    (1, 1): ((1, 0, 0), (0, 0, 1), (0, -1, 0)),  # down
    (1, -1): ((1, 0, 0), (0, 0, -1), (0, 1, 0)),  # up
    (2, -1): ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),  # behind
}
"""By axis of the lens and sign: its rotation `lens_from_face`, row by row."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Face:
    """A pinhole image, and which pixels of the lens are sampled from it."""

    name: str
    """Among the faces of its lens."""
    camera_from_face: Float[Tensor, "4 4"]
    pinhole: Camera
    """At the origin of the lens, in its frame."""
    rows: slice
    columns: slice
    """The part of the image that it has pixels in."""
    is_own: np.ndarray
    """Which pixels of that part are its own."""
    places: Float[np.ndarray, "rows columns 2"]
    """Where in the face the middles of the part's pixels lie, in pixels of the pinhole."""
    times: int
    """How many pixels are drawn for one of the pinhole, along one axis: Gaussians are made for the
    pixels that they were fitted to, in coarser ones thin things are too wide. A pixel of the lens
    is the mean over as many rays along either axis."""

    def at(self, world_from_camera: Float[Tensor, "4 4"]) -> Camera:
        """The face as a camera of the world, as fine as it is drawn."""
        fine = self.pinhole.resized(
            width_px=self.times * self.pinhole.width_px,
            height_px=self.times * self.pinhole.height_px,
        )
        return fine.at(world_from_camera @ self.camera_from_face)

    def sampled(
        self, drawn: Float[np.ndarray, "face_height face_width 3"]
    ) -> Float[np.ndarray, "rows columns 3"]:
        """The part of the lens' image that an image of the face gives, as fine as it is drawn.

        One ray a pixel looks between pixels by a cubic; of several rays each looks between the four
        that are nearest, for their mean is what counts.
        """
        between = cv2.INTER_CUBIC if self.times == 1 else cv2.INTER_LINEAR
        aside = (np.arange(self.times, dtype=np.float32) + 0.5) / self.times - 0.5
        found = np.zeros((*self.is_own.shape, 3), np.float32)
        to_right, to_below = (_steps(self.places, self.is_own, axis) for axis in (1, 0))
        for across, down in product(aside, aside):
            at = self.places + across * to_right + down * to_below
            # OpenCV counts from the middle of a pixel
            column, row = cv2.split(self.times * at - np.float32(0.5))
            found += cv2.remap(drawn, column, row, between, borderMode=cv2.BORDER_REPLICATE)
        return found / self.times**2


@dataclass(frozen=True, eq=False, kw_only=True)
class LensImage:
    """How the image of one lens is put together; the same for every pose."""

    camera: SensorCamera
    faces: tuple[Face, ...]
    is_seen: Bool[Tensor, "height width"]
    """Pixels that the lens has a ray for; others are black."""
    rays: Float[Tensor, "height width 3"]
    """float32, of unit length."""

    @classmethod
    def of(cls, camera: SensorCamera, fitted_px: float = 0.0) -> "LensImage":
        """Find the rays of a lens and the faces that they meet.

        Args:
            camera: The lens.
            fitted_px: Focal length of the images that Gaussians were fitted to; faces are drawn
                about as fine, or as they are sampled if that is finer.
        """
        rays, is_seen = camera.pixel_rays()
        seen = rays[is_seen]
        one_face = bool((seen[:, 2] > math.cos(ONE_FACE_RAD)).all())
        largest = rays.abs().argmax(dim=-1)
        if one_face:
            largest = torch.full_like(largest, 2)
        sign = torch.gather(rays, -1, largest[..., None])[..., 0].sign()
        parts = [
            _Part.of(str(number), rays, is_seen & (largest == axis) & (sign == side), turn)
            for number, ((axis, side), turn) in enumerate(_CUBE.items())
        ]
        met = [part for part in parts if part is not None]
        most = MOST_PIXELS * is_seen.numel()
        wanted = sum(part.area * part.focal_px**2 for part in met)
        coarser = min(1.0, math.sqrt(most / max(wanted, 1.0)))
        faces = [part.face(coarser * part.focal_px, fitted_px) for part in met]
        return cls(camera=camera, faces=tuple(faces), is_seen=is_seen, rays=rays.float())

    def drawn(
        self, draw: Callable[[Face], Float[Tensor, "face_height face_width 3"]]
    ) -> Float[Tensor, "height width 3"]:
        """The image, by what a function draws of each face; black where the lens sees nothing."""
        image = np.zeros((*self.is_seen.shape, 3), np.float32)
        for face in self.faces:
            sampled = face.sampled(draw(face).cpu().contiguous().numpy())
            image[face.rows, face.columns][face.is_own] = sampled[face.is_own]
        return torch.from_numpy(image)

    def meeting(
        self, mask: Bool[Tensor, "mask_height mask_width"], pinhole: Camera
    ) -> Bool[Tensor, "height width"]:
        """The pixels whose rays fall into a mask of a pinhole that stands where the lens does."""
        high, wide = mask.shape
        ahead = self.rays[..., 2].clamp(min=1e-6)
        column = (self.rays[..., 0] / ahead * pinhole.fx_px + pinhole.cx_px).floor().long()
        row = (self.rays[..., 1] / ahead * pinhole.fy_px + pinhole.cy_px).floor().long()
        inside = (self.rays[..., 2] > 0) & (column >= 0) & (row >= 0)
        inside &= (column < wide) & (row < high)
        return inside & mask[row.clamp(0, high - 1), column.clamp(0, wide - 1)]


@dataclass(frozen=True, eq=False)
class _Part:
    """The rays of a lens that meet one face, one unit ahead of it."""

    name: str
    turn: Rows
    own: Bool[Tensor, "height width"]
    met: Float[Tensor, "height width 2"]
    """Where; means nothing but for the own ones."""
    focal_px: float
    """At which the face is as fine as wanted."""

    @classmethod
    def of(
        cls,
        name: str,
        rays: Float[Tensor, "height width 3"],
        own: Bool[Tensor, "height width"],
        turn: Rows,
    ) -> "_Part | None":
        """None where no ray meets the face."""
        if not bool(own.any()):
            return None
        seen = rays @ rays.new_tensor(turn)
        met = seen[..., :2] / torch.where(own, seen[..., 2], 1.0)[..., None]
        return cls(name, turn, own, met, DENSITY / _finest_step(met, own))

    @property
    def area(self) -> float:
        """Of the rectangle that holds what is met."""
        met = self.met[self.own]
        return float((met.amax(0) - met.amin(0)).prod())

    def face(self, focal_px: float, fitted_px: float) -> Face:
        """The face with pixels so fine, drawn as fine as what was fitted."""
        met = self.met[self.own] * focal_px
        low = (met.amin(0).floor() - MARGIN_PX).tolist()
        high = (met.amax(0).ceil() + MARGIN_PX).tolist()
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.tensor(self.turn, dtype=torch.float64)
        pinhole = Camera(
            world_from_camera=pose,
            fx_px=focal_px,
            fy_px=focal_px,
            cx_px=-low[0],
            cy_px=-low[1],
            width_px=round(high[0] - low[0]),
            height_px=round(high[1] - low[1]),
        )
        rows, columns = (_reach(self.own.any(dim=axis)) for axis in (1, 0))
        part = self.own[rows, columns]
        places = torch.zeros(*part.shape, 2, dtype=torch.float32)
        places[part] = (met - met.new_tensor(low)).float()
        return Face(
            name=self.name,
            camera_from_face=pose,
            pinhole=pinhole,
            rows=rows,
            columns=columns,
            is_own=part.numpy(),
            places=places.numpy(),
            times=min(max(round(fitted_px / focal_px), 1), MOST_TIMES),
        )


def _finest_step(met: Float[Tensor, "height width 2"], own: Bool[Tensor, "height width"]) -> float:
    """Between neighbouring pixels on a face, but for the hundredth that are nearest together."""
    steps = []
    for axis in (0, 1):
        count = own.shape[axis] - 1
        both = own.narrow(axis, 1, count) & own.narrow(axis, 0, count)
        steps.append(met.diff(dim=axis).norm(dim=-1)[both])
    found = torch.cat(steps)
    if not len(found):
        return 1.0
    return float(found.kthvalue(1 + len(found) // 100).values.clamp(min=1e-6))


def _steps(
    places: Float[np.ndarray, "rows columns 2"], is_own: np.ndarray, axis: int
) -> Float[np.ndarray, "rows columns 2"]:
    """From each place to its neighbour's along an axis: the mean of both sides, where both are own.

    A pixel without an own neighbour there has a step of nothing.
    """
    before, after = (slice(None),) * axis + (slice(-1),), (slice(None),) * axis + (slice(1, None),)
    both = (is_own[before] & is_own[after])[..., None]
    step = np.where(both, np.diff(places, axis=axis), np.float32(0))
    total, sides = np.zeros_like(places), np.zeros_like(places[..., :1])
    for side in (before, after):
        total[side] += step
        sides[side] += both
    return total / np.maximum(sides, 1)


def _reach(is_there: Bool[Tensor, " places"]) -> slice:
    found = is_there.nonzero()[:, 0]
    return slice(int(found[0]), int(found[-1]) + 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class ReadByLens(PosedScene):
    """A scene before a face of a lens whose shutter rolls over the lens' own image."""

    rates: Float[Tensor, "bodies 3 4"]
    """How bodies move before the lens; see `rolling_shutter.body_rates`."""
    readout_s: float
    read_s: ReadingTimes
    """When points of the face's frame are read."""

    @classmethod
    def of_face(
        cls,
        posed: PosedScene,
        rates: Float[Tensor, "bodies 3 4"],
        shutter: Shutter,
        read_s: ReadingTimes,
    ) -> "ReadByLens":
        """A scene before a face, and how the shutter of its lens reads it."""
        own: dict[str, Any] = {each.name: getattr(posed, each.name) for each in fields(posed)}
        readout_s = sum(map(abs, shutter.across_s))
        return cls(**own, rates=rates, readout_s=readout_s, read_s=read_s)

    def looks(self) -> list[View]:
        """The face in the middle of the readout, at its beginning and at its end."""
        moments = bodies_apart(self.bodies, self.rates, self.readout_s / 2)
        return [(self.camera, bodies) for bodies in (self.bodies, *moments)]

    def shown(self, gaussians: AnyGaussians) -> AnyGaussians:
        """Gaussians of the scene as the lens reads them, in the frames of their bodies."""
        then = gaussians_at(gaussians, self.actors, self.blinking, self.taken_ns)
        poses, rates = (each[:, :3].to(then.means) for each in (self.bodies, self.rates))
        offset_m, log_growth = motion_by_times(
            then.means, then.rotation_wxyz, then.body_index, poses, rates, read_s=self.read_s
        )
        return replace(then, means=then.means + offset_m, log_scale=then.log_scale + log_growth)


def reading_times(
    camera: SensorCamera, across_s: tuple[float, float], camera_from_face: Float[Tensor, "4 4"]
) -> ReadingTimes:
    """When a lens reads points of a face's frame: by the place of each in the distorted image."""

    def read_s(points: Float[Tensor, "points 3"]) -> Float[Tensor, " points"]:
        uv = camera.project(points @ camera_from_face[:3, :3].to(points).T)
        size = uv.new_tensor([camera.width_px, camera.height_px])
        return (uv / size - 0.5).clamp(-0.5, 0.5) @ uv.new_tensor(across_s)

    return read_s
