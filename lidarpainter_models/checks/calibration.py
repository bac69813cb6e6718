"""Whether each camera looks where the scene says: depth edges of the LiDAR against image edges.

Where a near surface ends before a far one, an image nearly always has an edge. The points at such
depth edges are projected into the images of several frames, turned by up to two degrees this way
and that; the turn under which they lie best on image edges is how far the camera's stated
rotation is off (the idea of Levinson and Thrun, 2013, with a search in place of their gradient).

Depth edges across the beams are compared with vertical image edges and those along them with
horizontal ones. The edge strength is taken against its surroundings of two degrees, else trees and
other broad texture would draw everything to them. Points of moving actors are left out, and the
slower half of the frames is taken: a camera clock that is off moves what is seen as a turn would,
the more the faster the car is. A turn about the optical axis (roll) is looked for last, at the best
yaw and pitch and at none (a roll can look like a small one of these), and judged where it stands
out: it moves the sides of an image alone.

Camera frame: x right, y down, z forward. Yaw turns about y, pitch about x, roll about z.
"""

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch

from lidarpainter_models.geometry.boxes import is_inside_box
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import Sweep

Verdict = Literal["ok", "warn", "fail"]

MAX_TURN_DEG = 0.6
"""A camera farther off is wrong.

Sound cameras of PandaSet 002 and of synthetic streets are found within 0.25 degrees, one step of
the search (one of twelve at 0.5 in roll); those a degree off in yaw or pitch at 0.75 at least. Of
twelve rolls of a degree planted in PandaSet 002 ten are found, the others at 0.5 and as a pitch.
"""
MIN_PEAK = 3.5
"""How many deviations the best turn must stand out from the turns around it to be believed.

With cameras of the same scenes turned by five degrees or more, where no turn can be right, the best
one stands out by 3.0 (median); where it is right, by 5.
"""
MIN_EDGE_POINTS = 500
"""Fewer, over all frames, say nothing."""
_NUM_FRAMES = 8
_TURNS_DEG = np.arange(-2.0, 2.01, 0.25)
_ROLLS_DEG = np.arange(-3.0, 3.01, 0.25)
_PEAK_WIDTH_DEG, _ROLL_PEAK_WIDTH_DEG = 0.6, 0.8
"""Turns this near to the best one score well because of it."""
_MAX_WIDTH_PX = 960
"""Larger images are halved or more first: a degree stays at least eight pixels."""
_MIN_PX_PER_DEG = 2.2
"""In coarser images blurred edges of a street move the best turn by a degree."""
_BLUR_DEG, _SURROUNDINGS_DEG = 0.15, 2.0
_CELL_DEG = (0.35, 0.25)
"""Elevation and azimuth of a cell of the range image; beams lie 0.2 to 1.3 degrees apart."""
_REACH_CELLS = 4
_RANGES_M = (2.0, 60.0)
_MIN_JUMP_M, _MIN_JUMP_SHARE, _FULL_JUMP_M = 1.0, 0.2, 3.0
_MAX_POINTS = 4000
"""Of one frame and kind of edge."""
_ACTOR_MARGIN_M = 0.4


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgePoints:
    """Points on the near side of a depth edge, in the world."""

    xyz_m: np.ndarray
    weight: np.ndarray
    """Larger for deeper steps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraTurn:
    """How far a camera's rotation is off."""

    yaw_deg: float
    pitch_deg: float
    peak: float
    """How many deviations yaw and pitch stand out."""
    roll_deg: float
    roll_peak: float
    """How many deviations the roll stands out."""
    num_points: int

    @property
    def is_wrong(self) -> bool:
        """Whether a turn that stands out is larger than sound cameras show."""
        turned_deg = max(abs(self.yaw_deg), abs(self.pitch_deg))
        is_turned = self.peak >= MIN_PEAK and turned_deg > MAX_TURN_DEG
        return is_turned or (self.roll_peak >= MIN_PEAK and abs(self.roll_deg) > MAX_TURN_DEG)

    def __str__(self) -> str:
        yaw_pitch = f"yaw {self.yaw_deg:+.2f} pitch {self.pitch_deg:+.2f}"
        roll = f"roll {self.roll_deg:+.2f}"
        return f"{yaw_pitch} {_trust(self.peak)}, {roll} {_trust(self.roll_peak)}"


def _trust(peak: float) -> str:
    if peak >= MIN_PEAK:
        return "trusted"
    return f"not trusted (stands out by {peak:.1f} deviations from other turns, not {MIN_PEAK})"


def check_calibration(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether depth edges lie on image edges without turning any camera."""
    edges: dict[int, dict[str, EdgePoints]] = {}
    if any(_is_fine_enough(_reduced(view.camera)) for view in scene.views):
        edges = {frame_index: depth_edges(scene, frame_index) for frame_index in slow_frames(scene)}
    found = {name: best_turn(scene, name, edges) for name in scene.camera_names}
    wrong, unsure, details = [], [], []
    for name, turn in found.items():
        if turn is None:
            details.append(f"{name} cannot be told ({_why_untold(scene, name)})")
            continue
        details.append(f"{name} {turn}")
        if turn.is_wrong:
            wrong.append(name)
        elif turn.peak < MIN_PEAK:
            unsure.append(name)
    detail = f"degrees off: {'; '.join(details)}"
    if wrong:
        return "fail", f"{', '.join(wrong)} turned on its mount; {detail}"
    if unsure:
        return "warn", f"{', '.join(unsure)}: no turn within 2 degrees fits the edges; {detail}"
    return "ok", detail


def slow_frames(scene: DrivingScene) -> list[int]:
    """A few frames with sweeps, spread over the slower half of a log; all of a short one."""
    swept = sorted({sweep.frame_index for sweep in scene.sweeps})
    if len(swept) > 2:
        rows = [scene.frame_position(frame_index) for frame_index in swept]
        place_m = scene.world_from_ego[rows, :3, 3].numpy()
        time_s = scene.frame_timestamps_ns[rows].numpy() / 1e9
        speed_mps = np.linalg.norm(np.gradient(place_m, time_s, axis=0), axis=1)
        slower = np.argsort(speed_mps, kind="stable")[: max(_NUM_FRAMES, len(swept) // 2)]
        swept = [swept[place] for place in sorted(slower)]
    places = np.linspace(0, len(swept) - 1, min(len(swept), _NUM_FRAMES)).round().astype(int)
    return [swept[place] for place in np.unique(places)]


def best_turn(
    scene: DrivingScene, camera_name: str, edges: dict[int, dict[str, EdgePoints]]
) -> CameraTurn | None:
    """The turn of a camera that puts depth edges on image edges; None where none can be told."""
    views = [view for view in scene.views_of(camera_name) if view.frame_index in edges]
    images = []
    for view in views:
        camera = _reduced(view.camera)
        if not _is_fine_enough(camera):
            return None
        size = camera.width_px, camera.height_px
        rgb = cv2.resize(scene.read_image(view).numpy(), size, interpolation=cv2.INTER_AREA)
        points = _in_camera(edges[view.frame_index], camera)
        images.append((_edge_strengths(rgb, camera), camera, points))
    num_points = sum(len(points) for *_, kinds in images for points, _ in kinds.values())
    if num_points < MIN_EDGE_POINTS:
        return None
    plane = np.array([[_score(images, (p, yaw, 0)) for yaw in _TURNS_DEG] for p in _TURNS_DEG])
    row, column = np.unravel_index(plane.argmax(), plane.shape)
    yaw_deg, pitch_deg = _TURNS_DEG[column], _TURNS_DEG[row]
    line = max(_roll_scores(images, pitch_deg, yaw_deg), _roll_scores(images, 0, 0), key=max)
    roll_deg = _ROLLS_DEG[line.argmax()]
    apart = np.hypot(_TURNS_DEG[None] - yaw_deg, _TURNS_DEG[:, None] - pitch_deg)
    return CameraTurn(
        yaw_deg=float(yaw_deg),
        pitch_deg=float(pitch_deg),
        peak=_peak(plane, apart > _PEAK_WIDTH_DEG),
        roll_deg=float(roll_deg),
        roll_peak=_peak(line, np.abs(_ROLLS_DEG - roll_deg) > _ROLL_PEAK_WIDTH_DEG),
        num_points=num_points,
    )


def _reduced(camera: Camera) -> Camera:
    """The camera of the image that is looked at."""
    share = min(1.0, _MAX_WIDTH_PX / camera.width_px)
    return camera.resized(
        width_px=round(camera.width_px * share), height_px=round(camera.height_px * share)
    )


def _is_fine_enough(camera: Camera) -> bool:
    return _px_per_deg(camera) >= _MIN_PX_PER_DEG


def _px_per_deg(camera: Camera) -> float:
    return camera.fx_px * math.radians(1.0)


def _why_untold(scene: DrivingScene, camera_name: str) -> str:
    px_per_deg = min(_px_per_deg(_reduced(view.camera)) for view in scene.views_of(camera_name))
    if px_per_deg < _MIN_PX_PER_DEG:
        return f"images of {px_per_deg:.1f} pixels a degree, {_MIN_PX_PER_DEG} are needed"
    return f"fewer than {MIN_EDGE_POINTS} points at depth edges in its images"


def depth_edges(scene: DrivingScene, frame_index: int) -> dict[str, EdgePoints]:
    """Points where a near surface ends: `across` neighbouring azimuths, or `along` elevations."""
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {"across": [], "along": []}
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
        kind: EdgePoints(
            xyz_m=np.concatenate([xyz_m for xyz_m, _ in parts] or [np.zeros((0, 3))]),
            weight=np.concatenate([weight for _, weight in parts] or [np.zeros(0)]),
        )
        for kind, parts in found.items()
    }


def _standing_points(scene: DrivingScene, sweep: Sweep) -> np.ndarray:
    """The points of a sweep outside moving actors, float64."""
    xyz_m = scene.read_sweep(sweep).xyz_m
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


def _in_camera(
    edges: dict[str, EdgePoints], camera: Camera
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Edge points in front of a camera, in its frame, with their weights."""
    camera_from_world = camera.camera_from_world.numpy()
    kinds = {}
    for kind, points in edges.items():
        xyz_m = points.xyz_m @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        reach = camera.width_px / camera.fx_px * xyz_m[:, 2]
        ahead = (xyz_m[:, 2] > 0.5) & (np.abs(xyz_m[:, 0]) < reach)
        kinds[kind] = xyz_m[ahead], points.weight[ahead]
    return kinds


def _score(images: list, turn_deg: tuple[float, float, float]) -> float:
    """Weighted mean edge strength at the points of all images, with the camera turned.

    The turn is a rotation vector: pitch, yaw, roll.
    """
    rotation = cv2.Rodrigues(np.radians(np.array(turn_deg, dtype=np.float64)))[0]
    total = weights = 0.0
    for strengths, camera, kinds in images:
        for kind, (xyz_m, weight) in kinds.items():
            x, y, z = rotation @ xyz_m.T
            z = np.maximum(z, 0.1)
            u = np.floor(camera.fx_px * x / z + camera.cx_px)
            v = np.floor(camera.fy_px * y / z + camera.cy_px)
            seen = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
            strength = strengths[kind][v[seen].astype(int), u[seen].astype(int)]
            total += float(strength @ weight[seen])
            weights += float(weight[seen].sum())
    return total / max(weights, 1e-9)


def _roll_scores(images: list, pitch_deg: float, yaw_deg: float) -> np.ndarray:
    return np.array([_score(images, (pitch_deg, yaw_deg, roll)) for roll in _ROLLS_DEG])


def _peak(scores: np.ndarray, is_apart: np.ndarray) -> float:
    """How many deviations the best score stands out from those of turns not near it."""
    others = scores[is_apart]
    return float((scores.max() - others.mean()) / max(float(others.std()), 1e-9))
