"""Pinhole cameras.

Camera frame: x right, y down, z forward. The top-left pixel has its centre at (0.5, 0.5), so a
point projects to u = fx x / z + cx with cx measured from the image's left edge.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import hypot, isfinite

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.transforms import invert_rigid, is_rigid, transform_points

LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
"""What a camera is besides its pose and its shutter."""
READ_ROUNDS = 2  # a second guess of where a point is read moves it by less than 0.01 px


@dataclass(frozen=True, kw_only=True, eq=False)
class Shutter:
    """How an image is read while its camera moves on.

    A pixel (u, v) is read `across_s @ (u / width - 0.5, v / height - 0.5)` after the middle of the
    image, when the camera stands where it is said to.
    """

    across_s: tuple[float, float] = (0.0, 0.0)
    """From the left end of the image to the right, and from the top to the bottom; both 0 where
    all of it is read at once."""
    late_s: float = 0.0
    """How much after its timestamp the image was taken."""
    twist_per_s: Float[Tensor, "6"]
    """Turn (rad/s) and velocity (m/s) of the camera in its own frame."""

    @property
    def is_rolling(self) -> bool:
        """Whether the image is read bit by bit."""
        return self.across_s != (0.0, 0.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Camera:
    """One pinhole view: where it stands (float64) and how it projects."""

    world_from_camera: Float[Tensor, "4 4"]
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width_px: int
    height_px: int
    shutter: Shutter | None = None
    """Of a recorded image; None for a view that is taken at once."""

    def __post_init__(self) -> None:
        """Refuse poses and focal lengths that cannot project."""
        if not bool(is_rigid(self.world_from_camera)):
            raise ConfigError("a camera needs a finite rigid world_from_camera")
        lens = (self.fx_px, self.fy_px, self.cx_px, self.cy_px)
        if not all(isfinite(number) for number in lens):
            raise ConfigError(f"a camera needs a finite lens, got fx, fy, cx, cy = {lens}")
        if min(self.fx_px, self.fy_px) <= 0 or min(self.width_px, self.height_px) <= 0:
            raise ConfigError(
                f"a camera needs positive focal lengths and size, got fx {self.fx_px}, "
                f"fy {self.fy_px}, {self.width_px} x {self.height_px} px"
            )

    @classmethod
    def centred(
        cls,
        world_from_camera: Float[Tensor, "4 4"],
        focal_px: float,
        *,
        width_px: int,
        height_px: int,
    ) -> "Camera":
        """A camera of square pixels that looks through the middle of its image."""
        return cls(
            world_from_camera=world_from_camera,
            fx_px=focal_px,
            fy_px=focal_px,
            cx_px=width_px / 2,
            cy_px=height_px / 2,
            width_px=width_px,
            height_px=height_px,
        )

    @property
    def camera_from_world(self) -> Float[Tensor, "4 4"]:
        """The inverse pose, float64."""
        return invert_rigid(self.world_from_camera)

    @property
    def centre_world(self) -> Float[Tensor, "3"]:
        """Where the camera stands, metres."""
        return self.world_from_camera[:3, 3]

    @property
    def shutter_name(self) -> str:
        """How the image is read, as simulators call it: `GLOBAL`, `ROLLING_TOP_TO_BOTTOM`, ..."""
        if self.shutter is None or not self.shutter.is_rolling:
            return "GLOBAL"
        columns_s, rows_s = self.shutter.across_s
        if abs(rows_s) >= abs(columns_s):
            return "ROLLING_TOP_TO_BOTTOM" if rows_s > 0 else "ROLLING_BOTTOM_TO_TOP"
        return "ROLLING_LEFT_TO_RIGHT" if columns_s > 0 else "ROLLING_RIGHT_TO_LEFT"

    def packed(self) -> Float[Tensor, "26"]:
        """What kernels read of a camera; float64.

        Three rows of `camera_from_world`, fx, fy, cx, cy, width and height in pixels, the two
        seconds of `Shutter.across_s`, and `Shutter.twist_per_s`, which is 0 without a shutter.
        """
        pose = self.camera_from_world
        sizes = [self.fx_px, self.fy_px, self.cx_px, self.cy_px, self.width_px, self.height_px]
        across_s = (0.0, 0.0) if self.shutter is None else self.shutter.across_s
        twist = torch.zeros(6) if self.shutter is None else self.shutter.twist_per_s
        return torch.cat([pose[:3].flatten(), pose.new_tensor([*sizes, *across_s]), twist.to(pose)])

    def at(self, world_from_camera: Float[Tensor, "4 4"]) -> "Camera":
        """The same lens at another pose, where nothing was recorded: without a shutter."""
        return replace(self, world_from_camera=world_from_camera, shutter=None)

    def refined(self, world_from_camera: Float[Tensor, "4 4"]) -> "Camera":
        """The same recorded image, taken from a better known pose: with its shutter."""
        return replace(self, world_from_camera=world_from_camera)

    def taken_ns(self, timestamp_ns: int) -> int:
        """When an image with a timestamp was really taken."""
        return timestamp_ns + (0 if self.shutter is None else round(self.shutter.late_s * 1e9))

    def read_s(self, pixels_uv: Float[Tensor, "*points 2"]) -> Float[Tensor, "*points"]:
        """How long after the middle of the image pixels are read; beyond it, as at its edge."""
        columns_s, rows_s = (0.0, 0.0) if self.shutter is None else self.shutter.across_s
        u, v = pixels_uv.unbind(-1)
        across = (u / self.width_px - 0.5).clamp(-0.5, 0.5)
        return columns_s * across + rows_s * (v / self.height_px - 0.5).clamp(-0.5, 0.5)

    def resized(self, *, width_px: int, height_px: int) -> "Camera":
        """The same view on another pixel grid (pixel edges stay aligned)."""
        scale_x, scale_y = width_px / self.width_px, height_px / self.height_px
        return replace(
            self,
            fx_px=self.fx_px * scale_x,
            fy_px=self.fy_px * scale_y,
            cx_px=self.cx_px * scale_x,
            cy_px=self.cy_px * scale_y,
            width_px=width_px,
            height_px=height_px,
        )

    def no_wider(self, width_px: int) -> "Camera":
        """The same view so many pixels wide at most, in its own proportions; never enlarged."""
        width_px = min(width_px, self.width_px)
        height_px = max(round(self.height_px * width_px / self.width_px), 1)
        return self.resized(width_px=width_px, height_px=height_px)

    def project(
        self, points_world: Float[Tensor, "points 3"]
    ) -> tuple[Float[Tensor, "points 2"], Float[Tensor, " points"]]:
        """Continuous pixel positions and depth (camera z, metres) of world points.

        A point with depth <= 0 is behind the camera: its pixel position means nothing. Points stand
        still while the image is read.
        """
        camera_from_world = self.camera_from_world.to(points_world, non_blocking=True)
        points = transform_points(camera_from_world, points_world)
        pixels_uv = self._pixels_of(points)
        if self.shutter is not None and self.shutter.is_rolling:
            standing, velocity = points, _velocity(self.shutter, points)
            for _ in range(READ_ROUNDS):
                points = standing + self.read_s(pixels_uv)[:, None] * velocity
                pixels_uv = self._pixels_of(points)
        return pixels_uv, points[:, 2]

    def _pixels_of(self, points: Float[Tensor, "points 3"]) -> Float[Tensor, "points 2"]:
        """Continuous pixel positions of points of the camera's frame."""
        depth_m = points[:, 2]
        safe = torch.where(depth_m.abs() < 1e-9, torch.full_like(depth_m, 1e-9), depth_m)
        u = points[:, 0] / safe * self.fx_px + self.cx_px
        v = points[:, 1] / safe * self.fy_px + self.cy_px
        return torch.stack([u, v], dim=-1)

    def contains(
        self,
        pixels_uv: Float[Tensor, "points 2"],
        depth_m: Float[Tensor, " points"],
        *,
        near_m: float = 0.1,
    ) -> Bool[Tensor, " points"]:
        """Whether projected points fall into the image, in front of `near_m`."""
        u, v = pixels_uv.unbind(-1)
        inside = (u >= 0) & (u < self.width_px) & (v >= 0) & (v < self.height_px)
        return inside & (depth_m > near_m)

    def may_see(
        self, centres_world: Float[Tensor, "balls 3"], radius_m: Float[Tensor, " balls"]
    ) -> Bool[Tensor, " balls"]:
        """Whether any part of each ball can fall into the image; false where surely none does."""
        seen_from = self.camera_from_world.to(centres_world.device)
        x, y, z = transform_points(seen_from, centres_world.double()).unbind(-1)
        right_px, below_px = self.width_px - self.cx_px, self.height_px - self.cy_px
        inside_m = torch.stack(
            [
                z,
                (x * self.fx_px + z * self.cx_px) / hypot(self.fx_px, self.cx_px),
                (z * right_px - x * self.fx_px) / hypot(self.fx_px, right_px),
                (y * self.fy_px + z * self.cy_px) / hypot(self.fy_px, self.cy_px),
                (z * below_px - y * self.fy_px) / hypot(self.fy_px, below_px),
            ]
        )
        return inside_m.amin(dim=0) > -radius_m - 1e-3

    def pixel_directions(
        self, device: torch.device | None = None
    ) -> Float[Tensor, "height width 3"]:
        """Camera-frame directions through the pixel centres with z = 1, float32.

        Multiplied by a depth map they give camera-frame points.
        """
        column = torch.arange(self.width_px, dtype=torch.float32, device=device)
        row = torch.arange(self.height_px, dtype=torch.float32, device=device)
        u = (column + 0.5 - self.cx_px) / self.fx_px
        v = (row + 0.5 - self.cy_px) / self.fy_px
        grid_v, grid_u = torch.meshgrid(v, u, indexing="ij")
        return torch.stack([grid_u, grid_v, torch.ones_like(grid_u)], dim=-1)

    def unproject(self, depth_m: Float[Tensor, "height width"]) -> Float[Tensor, "height width 3"]:
        """World points (float32) seen at each pixel centre at the given camera z.

        What `project` takes back to the pixel and its depth: points stand still while it is read.
        """
        points_camera = self.pixel_directions(depth_m.device) * depth_m[..., None]
        if self.shutter is not None and self.shutter.is_rolling:
            read = points_camera.reshape(-1, 3)
            centres_uv = self._pixels_of(self.pixel_directions(depth_m.device).reshape(-1, 3))
            after_s, standing = self.read_s(centres_uv)[:, None], read
            for _ in range(READ_ROUNDS):
                standing = read - after_s * _velocity(self.shutter, standing)
            points_camera = standing.reshape(points_camera.shape)
        world_from_camera = self.world_from_camera.to(torch.float32)
        world_from_camera = world_from_camera.to(depth_m.device, non_blocking=True)
        return points_camera @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]


def outside_all(
    points_world: Float[Tensor, "points 3"], cameras: Iterable[Camera]
) -> Int[Tensor, " outside"]:
    """Rows of the points that fall into no camera's image, whether anything hides them or not."""
    outside = torch.arange(len(points_world), device=points_world.device)
    for camera in cameras:
        outside = outside[~camera.contains(*camera.project(points_world[outside]))]
        if not len(outside):
            break
    return outside


def _velocity(shutter: Shutter, points: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
    """How points that stand move before the camera, in its frame, metres a second."""
    turn, speed = shutter.twist_per_s.to(points).split(3)
    return -torch.linalg.cross(turn.expand_as(points), points) - speed
