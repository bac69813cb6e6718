"""An image with what a style must know of the place: distance, sky, ground, and up."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.painter.filters import fill_push_pull
from lidarpainter_models.weather.light import luminance, to_linear

NEAR_GROUND_M = 30.0
"""The ground plane is fitted to what is nearer than this."""
GROUND_TOLERANCE_M = (1.0, 0.4, 0.2)
"""Surfaces count as ground up to this distance from the plane, fitted ever more closely."""
SKY_M = 1e5
"""Stands for infinity where points are reckoned with."""
RIM_RAD = 0.004
"""How far masks of sky stay away from outlines: 4 px at 1000 px focal length."""
FLATTENED_M = 0.45
"""Depth of a road is noisy by so much ..."""
SUNKEN_M = 1.5
"""... and downwards by more, for nothing lies under a road; deeper lies another road."""
LEAST_CAMERA_HEIGHT_M = 0.3
_LEAST_GROUND_PX = 50


@dataclass(frozen=True, kw_only=True, eq=False)
class StyleView:
    """One view to be styled."""

    rgb: Float[Tensor, "height width 3"]
    """As displayed, in [0, 1]."""
    depth_m: Float[Tensor, "_ _"]
    """Camera z; 0 where unknown. In the sky it means nothing."""
    sky: Float[Tensor, "height width"]
    """Share of the pixel that is sky, in [0, 1]."""
    camera: Camera | None = None
    """On the same grid, world z up. Without it, depth stands for distance, and what lies on the
    ground or above the horizon is unknown."""

    def __post_init__(self) -> None:
        size = tuple(self.rgb.shape[:2])
        camera = self.camera
        sizes = {size, tuple(self.depth_m.shape), tuple(self.sky.shape)}
        if camera is not None:
            sizes.add((camera.height_px, camera.width_px))
        if len(sizes) != 1:
            raise ShapeError(f"image, depth, sky and camera need one size, got {sorted(sizes)}")

    @property
    def surface(self) -> Bool[Tensor, "height width"]:
        """Pixels that show more surface than sky."""
        return self.sky < 0.5

    @property
    def focal_px(self) -> float:
        """Of the camera; without one that of a lens as wide as most: 60 degrees across."""
        return self.camera.fx_px if self.camera else 0.866 * self.rgb.shape[1]


def distances(view: StyleView) -> Float[Tensor, "height width"]:
    """Metres along the ray to the surface of every pixel; gaps are filled from around them.

    The filling is that of inverse depth, in which planes are smooth. Sky counts as infinitely far;
    an image without any depth is treated as nothing but sky.
    """
    known = (view.depth_m > 0) & view.surface
    inverse = torch.where(known, 1 / view.depth_m.clamp_min(1e-3), 0)
    if not bool((known | ~view.surface).all()):
        planes = inverse.expand(1, 3, -1, -1).contiguous()
        inverse = fill_push_pull(planes, known[None, None].float())[0, 0]
    depth_m = torch.where(view.surface, 1 / inverse.clamp_min(1e-6), torch.inf)
    if view.camera is None:
        return depth_m
    return depth_m * view.camera.pixel_directions().norm(dim=-1)


def open_sky(view: StyleView) -> Float[Tensor, "height width"]:
    """Share of sky once more, seen through what is thinner than a pixel along its rim.

    Masks of sky stop short of wires and outlines, whose pixels still hold much of its light. There
    a pixel counts as sky as far as it is as bright as the sky around it. A rendered sky has shares
    of its own and stays as it is.
    """
    sky = view.sky.numpy()
    if bool(((sky > 0) & (sky < 1)).any()):
        return view.sky
    solid = cv2.morphologyEx((sky > 0.9).astype(np.float32), cv2.MORPH_OPEN, np.ones((7, 7)))
    grey = luminance(to_linear(view.rgb)).numpy()
    sigma_px = max(RIM_RAD * view.focal_px, 1.0)
    share = cv2.GaussianBlur(solid, (0, 0), 2 * sigma_px)
    around = cv2.GaussianBlur(solid * grey, (0, 0), 2 * sigma_px) / np.maximum(share, 1e-3)
    side = 2 * round(2 * sigma_px) + 1
    rim = cv2.dilate(solid, np.ones((side, side), np.uint8))
    rim = cv2.GaussianBlur(rim, (0, 0), sigma_px / 2) * (share > 1e-3)
    as_bright = np.clip((grey / np.maximum(around, 1e-3) - 0.15) / 0.6, 0, 1)
    return torch.from_numpy(np.maximum(sky, rim * as_bright))


def elevations(camera: Camera) -> Float[Tensor, "height width"]:
    """Angle of every pixel's ray above the horizon, radians."""
    return torch.asin(ray_directions(camera)[..., 2].clamp(-1, 1))


def ray_directions(camera: Camera) -> Float[Tensor, "height width 3"]:
    """Unit vectors in the world along every pixel's ray."""
    directions = torch.nn.functional.normalize(camera.pixel_directions(), dim=-1)
    return directions @ camera.world_from_camera[:3, :3].T.float()


def surface_points(
    camera: Camera, distance_m: Float[Tensor, "height width"]
) -> Float[Tensor, "height width 3"]:
    """Where every pixel's surface lies: metres from the camera centre, along the world's axes.

    Sky lies at `SKY_M`.
    """
    return ray_directions(camera) * distance_m.clamp_max(SKY_M)[..., None]


def quantile(values: Float[Tensor, " pixels"], share: float) -> Float[Tensor, ""]:
    """A value that so large a share does not reach; `torch.quantile` takes no large images."""
    return values.kthvalue(max(1, round(share * len(values)))).values


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """A plane z = a x + b y + c under the camera, in metres from its centre."""

    slope_and_level: Float[Tensor, "3"]

    @property
    def camera_height_m(self) -> float:
        """Of the camera above it."""
        return -float(self.slope_and_level[2])

    def heights(self, points_m: Float[Tensor, "*grid 3"]) -> Float[Tensor, "*grid"]:
        """Metres of points above it."""
        ones = torch.cat([points_m[..., :2], torch.ones_like(points_m[..., :1])], dim=-1)
        return points_m[..., 2] - ones @ self.slope_and_level

    def flattened(self, points_m: Float[Tensor, "*grid 3"]) -> Float[Tensor, "*grid 3"]:
        """The same points, those close to it moved along their rays until they lie in it."""
        height_m = self.heights(points_m)
        scale = self.camera_height_m / (self.camera_height_m - height_m).clamp_min(0.1)
        is_close = (height_m < FLATTENED_M) & (height_m > -SUNKEN_M)
        return torch.where(is_close[..., None], points_m * scale[..., None], points_m)


def fit_ground(
    points_m: Float[Tensor, "height width 3"], known: Bool[Tensor, "height width"]
) -> Ground | None:
    """The plane of the lowest near surfaces; None where too little of it is seen.

    Points are metres from the camera centre, z up; those of `known` pixels mean something.
    """
    near = known & (points_m.norm(dim=-1) < NEAR_GROUND_M)
    if int(near.sum()) < _LEAST_GROUND_PX:
        return None
    samples = points_m[near]
    rows = torch.cat([samples[:, :2], torch.ones(len(samples), 1)], dim=-1)
    lowest = samples[:, 2].kthvalue(max(1, len(samples) // 10)).values
    plane = torch.stack([torch.zeros(()), torch.zeros(()), lowest])
    for tolerance_m in GROUND_TOLERANCE_M:
        close = (samples[:, 2] - rows @ plane).abs() < tolerance_m
        if int(close.sum()) < _LEAST_GROUND_PX:
            return None
        # in float64 the order of sums, which differs from run to run, no longer shows
        solved = torch.linalg.lstsq(rows[close].double(), samples[close, 2:].double())
        plane = solved.solution[:, 0].float()
    ground = Ground(slope_and_level=plane)
    return ground if ground.camera_height_m > LEAST_CAMERA_HEIGHT_M else None
