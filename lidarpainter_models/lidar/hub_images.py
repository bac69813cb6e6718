"""Some images of a camera, and points of what stands that its other images show as well.

Hubs lie evenly over a recording; the points of each are followed into the images before and after
it. Camera frame: x right, y down, z forward; lengths are metres.

Images are contrasts at several scales, to compare one surface in views from far and near. A level
is the logarithm of the brightness between two blurs, divided by its own deviation around (local
contrast normalisation, Jarrett et al. 2009): exposure, vignetting and shade do not count, and no
part of an image is calmer than another, so that nothing is gained by comparing calm parts. Levels
follow each other by half an octave: the same surface twice as near is looked at two levels higher.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera, Shutter
from lidarpainter_models.kernels.point_contrasts import LEVELS_PER_OCTAVE, NEAR_M
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.actor_separation import near_actors
from lidarpainter_models.lidar.sparse_depth import sparse_lidar_depth
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.lone_returns import confirmed_returns
from lidarpainter_models.scenes.records import RecordedView

FINEST_PX = 0.8
"""Deviation of the blur of level 0."""
NUM_LEVELS = 6
"""Levels 2 and 3 are compared, of points up to an octave nearer or farther."""
_SURROUNDINGS = 4  # levels; two octaves wider than the level itself
_DARKEST = 0.04
_CALM = 0.02
"""Deviation of plain surfaces: less is noise."""


def contrasts_of(rgb_u8: np.ndarray) -> Float[np.ndarray, "levels height width 3"]:
    """An image at all levels: contrast and its derivatives along u and v, float32."""
    grey = cv2.cvtColor(rgb_u8, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    scales = range(NUM_LEVELS + _SURROUNDINGS)
    blurs_px = [FINEST_PX * 2.0 ** (level / LEVELS_PER_OCTAVE) for level in scales]
    light = np.log(grey + _DARKEST)
    blurred = [cv2.GaussianBlur(light, (0, 0), blur_px) for blur_px in blurs_px]
    levels = np.empty((NUM_LEVELS, *grey.shape, 3), np.float32)
    for level in range(NUM_LEVELS):
        wide = level + _SURROUNDINGS
        band = blurred[level] - blurred[wide]
        spread = np.sqrt(cv2.GaussianBlur(band**2, (0, 0), blurs_px[wide]))
        contrast = band / (spread + _CALM)
        levels[level, ..., 0] = contrast
        for number, axis in enumerate(((1, 0), (0, 1)), start=1):
            levels[level, ..., number] = cv2.Sobel(contrast, cv2.CV_32F, *axis, scale=1 / 8)
    return levels


WIDTH_PX = 480
"""Images that are wider are made as small as this."""
_HUBS, _NEIGHBOURS, _POINTS = 8, 2, 1000
"""Images whose points are followed, into how many before and after, and of how many points."""
_FAR_M = 80.0
_EDGE_PX, _LEAST_SHARE, _MOST_SHARE = 11, 0.7, 1.4  # of its own depth, all around a point


@dataclass(frozen=True, eq=False)
class HubImage:
    """One image, what it moved like, and the returns of its frame's sweeps in it."""

    place: int
    """Position among the camera's images."""
    camera: Camera
    twist_per_s: Float[np.ndarray, "6"]
    contrasts: Float[np.ndarray, "levels height width 3"]
    """As of `contrasts_of`."""
    standing: Float[Tensor, "points 3"]
    """Points of the frame outside moving boxes, in the world."""
    depth_m: Float[np.ndarray, "height width"]
    """0 where there is no return."""
    nearest_m: Float[np.ndarray, "height width"]
    """Nearest return around, very far where there is none."""


@dataclass(frozen=True, eq=False)
class Hub:
    """Points of one image and the images that show them, it among them."""

    points: Float[np.ndarray, "points 3"]
    images: Sequence[HubImage]
    own: int

    def among(self, places: range) -> "Hub | None":
        """The hub with only the images of these places; None where it is not among them."""
        if self.images[self.own].place not in places:
            return None
        images = [image for image in self.images if image.place in places]
        return Hub(self.points, images, images.index(self.images[self.own]))


@dataclass(frozen=True, eq=False)
class FrameReturns:
    """What a frame's sweeps met, in the world."""

    xyz_m: Float[Tensor, "points 3"]
    standing: Float[Tensor, "standing 3"]
    """Those that moving actors do not keep out of the street."""


def returns_of(scene: DrivingScene, frames: Sequence[int]) -> dict[int, FrameReturns]:
    """The returns of some frames, read once for all cameras."""
    moving = [track for track in scene.tracks if track.is_moving]

    def read(frame_index: int) -> FrameReturns:
        clouds, standing = [torch.zeros(0, 3)], [torch.zeros(0, 3)]
        for sweep in scene.sweeps_of(frame_index):
            xyz_m, measured_ns = confirmed_returns(scene, sweep)
            stands = torch.ones(len(xyz_m), dtype=torch.bool)
            stands[near_actors(xyz_m, measured_ns, moving).rows] = False
            clouds.append(xyz_m)
            standing.append(xyz_m[stands])
        return FrameReturns(xyz_m=torch.cat(clouds), standing=torch.cat(standing))

    return dict(zip(frames, side_by_side(read, frames), strict=True))


def hubs_of(
    scene: DrivingScene,
    moved: Sequence[tuple[RecordedView, Shutter]],
    returns: Mapping[int, FrameReturns],
    own_body: Bool[np.ndarray, "rows columns"] | None = None,
) -> list[Hub]:
    """What is compared of one camera's images; those that are nobody's neighbours are not read.

    What shows the recording car itself (on any grid) is not compared.
    """
    wanted = compared_images(len(moved))
    made = side_by_side(
        lambda place: _image(
            scene, place, *moved[place], returns[moved[place][0].frame_index], own_body
        ),
        wanted,
    )
    images = dict(zip(wanted, made, strict=True))
    hubs = []
    for own, around in hub_neighbours(len(moved)):
        points = _hub_points(images[own])
        if len(points):
            hubs.append(Hub(points, [images[index] for index in around], around.index(own)))
    return hubs


def compared_images(num_images: int) -> list[int]:
    """Positions of the hubs and of their neighbours among a camera's images."""
    return sorted({index for _, around in hub_neighbours(num_images) for index in around})


def hub_neighbours(num_images: int) -> list[tuple[int, range]]:
    """Positions of the hubs, evenly over a camera's images, each with those of its neighbours."""
    hubs = np.unique(np.linspace(0, num_images - 1, min(_HUBS, num_images)).round()).astype(int)
    return [
        (own, range(max(own - _NEIGHBOURS, 0), min(own + _NEIGHBOURS + 1, num_images)))
        for own in hubs.tolist()
    ]


def _image(
    scene: DrivingScene,
    place: int,
    view: RecordedView,
    shutter: Shutter,
    returns: FrameReturns,
    own_body: Bool[np.ndarray, "rows columns"] | None,
) -> HubImage:
    share = min(1.0, WIDTH_PX / view.camera.width_px)
    camera = view.camera.resized(
        width_px=round(view.camera.width_px * share), height_px=round(view.camera.height_px * share)
    )
    size = (camera.width_px, camera.height_px)
    rgb = cv2.resize(scene.read_image(view).numpy(), size, interpolation=cv2.INTER_AREA)
    depth_m = sparse_lidar_depth(returns.xyz_m, camera).numpy()
    far_m = np.where(depth_m > 0, depth_m, np.float32(1e6))
    if own_body is not None:
        is_own = cv2.resize(own_body.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        depth_m, far_m = np.where(is_own, 0, depth_m), np.where(is_own, -1e6, far_m)
    return HubImage(
        place=place,
        camera=camera,
        twist_per_s=shutter.twist_per_s.numpy(),
        contrasts=contrasts_of(rgb),
        standing=returns.standing,
        depth_m=depth_m,
        nearest_m=cv2.erode(far_m.astype(np.float32), np.ones((5, 5), np.uint8)),
    )


def _hub_points(image: HubImage) -> Float[np.ndarray, "points 3"]:
    """Visible points of what stands, away from depth edges; a random choice, always the same."""
    pixels_uv, depth_m = image.camera.project(image.standing)
    inside = image.camera.contains(pixels_uv, depth_m, near_m=NEAR_M).nonzero()[:, 0]
    column, row = pixels_uv[inside].long().numpy().T
    depth = depth_m[inside].numpy()
    window = np.ones((_EDGE_PX, _EDGE_PX), np.uint8)
    known = np.where(image.depth_m > 0, image.depth_m, np.float32(1e6))
    nearest, furthest = cv2.erode(known, window), cv2.dilate(image.depth_m, window)
    is_good = np.abs(depth - image.depth_m[row, column]) < 0.02 * depth
    is_good &= (nearest[row, column] > _LEAST_SHARE * depth) & (depth < _FAR_M)
    is_good &= furthest[row, column] < _MOST_SHARE * depth
    chosen = np.random.default_rng(0).permutation(np.flatnonzero(is_good))[:_POINTS]
    return image.standing[inside[torch.from_numpy(chosen)]].double().numpy()
