"""Depth edges of the LiDAR before the edges of images: how well the one lie on the other.

Where a near surface ends before a far one, an image nearly always has an edge. Depth edges across
the beams are compared with vertical image edges and those along them with horizontal ones. The
edge strength is taken against its surroundings of two degrees, else trees and other broad texture
would draw everything to them. Points of moving actors are left out, and the slower half of the
frames is taken: a camera clock that is off moves what is seen as a turn would, the more the faster
the car is.

Camera frame: x right, y down, z forward.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Float

from lidarpainter_models.checks.pictures import blank_cameras
from lidarpainter_models.checks.verdicts import sampled_positions
from lidarpainter_models.geometry.boxes import is_inside_box
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rotation_from_vector
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import Sweep

_NUM_FRAMES = 8
_MAX_WIDTH_PX = 960
"""Larger images are halved or more first: a degree stays at least eight pixels."""
_BLUR_DEG, _SURROUNDINGS_DEG = 0.15, 2.0
_CELL_DEG = (0.35, 0.25)
"""Elevation and azimuth of a cell of the range image; beams lie 0.2 to 1.3 degrees apart."""
_REACH_CELLS = 4
_RANGES_M = (2.0, 60.0)
_MIN_JUMP_M, _MIN_JUMP_SHARE, _FULL_JUMP_M = 1.0, 0.2, 3.0
_MAX_POINTS = 4000
"""Of one frame and kind of edge."""
_ACTOR_MARGIN_M = 0.4
_NO_POINTS = np.zeros((0, 3)), np.zeros(0)


EdgePoints = tuple[np.ndarray, np.ndarray]
"""Points on the near side of depth edges, and their weights, larger for deeper steps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeImage:
    """One image and the depth edges of its frame, by kind."""

    frame_index: int
    camera: Camera
    strengths: dict[str, np.ndarray]
    """How much more of an edge each pixel is than those around it."""
    points: dict[str, EdgePoints]
    """In the camera's frame."""

    def seen_from(self, camera: Camera) -> "EdgeImage":
        """The same points before a camera that stands or looks otherwise, in the same pixels."""
        moved = (camera.camera_from_world.double() @ self.camera.world_from_camera.double()).numpy()
        points = {
            kind: (xyz_m @ moved[:3, :3].T + moved[:3, 3], weight)
            for kind, (xyz_m, weight) in self.points.items()
        }
        return replace(self, points=points)


class SceneEdges:
    """The edge images of each camera of a scene, found once for all who look at them."""

    def __init__(self, scene: DrivingScene) -> None:
        self.scene = scene

    @cached_property
    def images(self) -> dict[str, list[EdgeImage]]:
        """By camera."""
        frames = _slow_frames(self.scene)
        edges = {frame_index: _depth_edges(self.scene, frame_index) for frame_index in frames}
        return {name: _edge_images(self.scene, name, edges) for name in self.scene.camera_names}

    @cached_property
    def blank(self) -> dict[str, str]:
        """What the images of cameras look like that show nothing, see `blank_cameras`."""
        return blank_cameras(self.scene)


def _slow_frames(scene: DrivingScene) -> list[int]:
    """A few frames with sweeps, spread over the slower half of a log; all of a short one."""
    swept = scene.swept_frames
    if len(swept) > 2:
        rows = [scene.frame_position(frame_index) for frame_index in swept]
        place_m = scene.world_from_ego[rows, :3, 3].numpy()
        time_s = scene.frame_timestamps_ns[rows].numpy() / 1e9
        speed_mps = np.linalg.norm(np.gradient(place_m, time_s, axis=0), axis=1)
        slower = np.argsort(speed_mps, kind="stable")[: max(_NUM_FRAMES, len(swept) // 2)]
        swept = [swept[place] for place in sorted(slower)]
    return [swept[place] for place in sampled_positions(len(swept), _NUM_FRAMES)]


def _edge_images(
    scene: DrivingScene, camera_name: str, edges: dict[int, dict[str, EdgePoints]]
) -> list[EdgeImage]:
    """The images of a camera in the frames whose depth edges are given."""
    found = []
    for view in scene.views_of(camera_name):
        if view.frame_index in edges:
            camera = _reduced(view.camera)
            size = camera.width_px, camera.height_px
            rgb = cv2.resize(scene.read_image(view).numpy(), size, interpolation=cv2.INTER_AREA)
            found.append(
                EdgeImage(
                    frame_index=view.frame_index,
                    camera=camera,
                    strengths=_edge_strengths(rgb, camera),
                    points=_in_camera(edges[view.frame_index], camera),
                )
            )
    return found


def _reduced(camera: Camera) -> Camera:
    """The camera of the image that is looked at."""
    share = min(1.0, _MAX_WIDTH_PX / camera.width_px)
    return camera.resized(
        width_px=round(camera.width_px * share), height_px=round(camera.height_px * share)
    )


def _depth_edges(scene: DrivingScene, frame_index: int) -> dict[str, EdgePoints]:
    """Where a near surface ends in the world: `across` azimuths, or `along` elevations."""
    found: dict[str, list[EdgePoints]] = {kind: [_NO_POINTS] for kind in ("across", "along")}
    for sweep in scene.sweeps_of(frame_index):
        xyz_m = _standing_points(scene, sweep)
        world_from_lidar = sweep.world_from_lidar.numpy()
        away_m = (xyz_m - world_from_lidar[:3, 3]) @ world_from_lidar[:3, :3]
        range_m = np.linalg.norm(away_m, axis=1)
        near = (range_m > _RANGES_M[0]) & (range_m < _RANGES_M[1])
        xyz_m, away_m, range_m = xyz_m[near], away_m[near], range_m[near]
        if len(range_m) == 0:
            continue
        rows, columns = _cells(away_m, range_m)
        image = np.full((rows.max() + 1, columns.max() + 1), np.inf)
        np.minimum.at(image, (rows, columns), range_m)
        least_m = np.maximum(_MIN_JUMP_M, _MIN_JUMP_SHARE * range_m)
        for kind, axis in (("across", 1), ("along", 0)):
            jump_m = _jumps(image, axis)[rows, columns]
            chosen = np.flatnonzero((jump_m > least_m) & (range_m <= image[rows, columns]))
            chosen = chosen[:: max(1, -(-len(chosen) // _MAX_POINTS))]
            weight = np.sqrt(np.minimum(jump_m[chosen], _FULL_JUMP_M))
            found[kind].append((xyz_m[chosen], weight))
    return {
        kind: (
            np.concatenate([xyz_m for xyz_m, _ in parts]),
            np.concatenate([weight for _, weight in parts]),
        )
        for kind, parts in found.items()
    }


def _standing_points(scene: DrivingScene, sweep: Sweep) -> np.ndarray:
    """The points of a sweep outside moving actors, float64."""
    xyz_m = scene.read_column(sweep, "xyz_m")
    stands = torch.ones(len(xyz_m), dtype=torch.bool)
    for track in scene.tracks:
        if track.is_moving and track.is_present(sweep.timestamp_ns):
            pose = track.pose_at(sweep.timestamp_ns)
            stands &= ~is_inside_box(xyz_m, pose, track.size_m, margin_m=_ACTOR_MARGIN_M)
    return xyz_m[stands].double().numpy()


def _cells(away_m: np.ndarray, range_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row (elevation) and column (azimuth) of each point in the range image."""
    elevation_deg = np.degrees(np.arcsin(np.clip(away_m[:, 2] / range_m, -1, 1)))
    azimuth_deg = np.degrees(np.arctan2(away_m[:, 1], away_m[:, 0]))
    rows = np.floor((elevation_deg + 90) / _CELL_DEG[0]).astype(int)
    columns = np.floor((azimuth_deg + 180) / _CELL_DEG[1]).astype(int)
    return rows - rows.min(), columns


def _jumps(image_m: np.ndarray, axis: int) -> np.ndarray:
    """How much farther the nearest filled cell on either side is, the larger of both, or 0."""
    padding = [(0, 0), (0, 0)]
    padding[axis] = (_REACH_CELLS, _REACH_CELLS)
    padded = np.pad(image_m, padding, constant_values=np.inf)
    size, jump_m = image_m.shape[axis], np.zeros(image_m.shape)
    for side in (-1, 1):
        beside_m = np.full(image_m.shape, np.inf)
        for step in range(_REACH_CELLS, 0, -1):
            start = _REACH_CELLS + side * step
            shifted = padded.take(range(start, start + size), axis=axis)
            beside_m = np.where(np.isfinite(shifted), shifted, beside_m)
        both = np.isfinite(image_m) & np.isfinite(beside_m)
        step_m = np.subtract(beside_m, image_m, where=both, out=np.zeros(image_m.shape))
        jump_m = np.maximum(jump_m, step_m)
    return jump_m


def _edge_strengths(rgb_u8: np.ndarray, camera: Camera) -> dict[str, np.ndarray]:
    """Vertical and horizontal edges, in deviations of the strength around them."""
    grey = cv2.cvtColor(rgb_u8, cv2.COLOR_RGB2GRAY).astype(np.float32)
    px_per_deg = camera.fx_px * np.radians(1.0)
    side_px = 2 * int(_SURROUNDINGS_DEG / 2 * px_per_deg) + 1
    strengths = {}
    for kind, order in (("across", (1, 0)), ("along", (0, 1))):
        edges = np.abs(cv2.Sobel(grey, cv2.CV_32F, *order))
        edges = np.minimum(edges, np.quantile(edges, 0.97))
        edges = cv2.GaussianBlur(edges, (0, 0), max(_BLUR_DEG * px_per_deg, 0.7))
        mean = cv2.blur(edges, (side_px, side_px))
        variance = np.maximum(cv2.blur(edges**2, (side_px, side_px)) - mean**2, 0)
        floor = 0.05 * float(edges.max()) + 1e-3  # noise of plain surfaces counts little
        strengths[kind] = (edges - mean) / np.sqrt(variance + floor**2)
    return strengths


def _in_camera(edges: dict[str, EdgePoints], camera: Camera) -> dict[str, EdgePoints]:
    """Edge points in front of a camera, in its frame."""
    camera_from_world = camera.camera_from_world.numpy()
    kinds = {}
    for kind, (world_m, weight) in edges.items():
        xyz_m = world_m @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        reach = camera.width_px / camera.fx_px * xyz_m[:, 2]
        ahead = (xyz_m[:, 2] > 0.5) & (np.abs(xyz_m[:, 0]) < reach)
        kinds[kind] = xyz_m[ahead], weight[ahead]
    return kinds


def edge_scores(
    images: Sequence[EdgeImage], turns_deg: Float[np.ndarray, "turns 3"]
) -> Float[np.ndarray, " turns"]:
    """Weighted mean edge strength at the points of all images, for each way to turn the camera.

    A turn is a rotation vector: pitch, yaw, roll.
    """
    rotations = rotation_from_vector(torch.from_numpy(np.radians(turns_deg)).float())
    total = torch.zeros(len(rotations), dtype=torch.float64)
    weights = torch.zeros_like(total)
    for image in images:
        camera = image.camera
        for kind, (xyz_m, weight) in image.points.items():
            x, y, z = (rotations @ torch.from_numpy(xyz_m.T).float()).unbind(dim=1)
            by_z = 1 / z.clamp(min=0.1)
            u = (camera.fx_px * x * by_z + camera.cx_px).floor()
            v = (camera.fy_px * y * by_z + camera.cy_px).floor()
            seen = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
            place = torch.where(seen, v * camera.width_px + u, 0).long()
            counted = torch.where(seen, torch.from_numpy(weight).float(), 0)
            total += (torch.from_numpy(image.strengths[kind]).take(place) * counted).sum(dim=1)
            weights += counted.sum(dim=1)
    return (total / weights.clamp(min=1e-9)).numpy()
