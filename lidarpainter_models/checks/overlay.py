"""Draw what the LiDAR and the boxes say over what a camera saw: the quickest check of a scene."""

from collections.abc import Collection, Sequence

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from lidarpainter_models.geometry.boxes import BOX_EDGES, box_corners
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.scenes.tracks import ActorTrack

_NEAREST_M, _FARTHEST_M = 3.0, 90.0
_NEAR_PLANE_M = 0.3
_LEGEND_PX, _LEGEND_WIDTH_PX, _RAMP_PX = 28, 700, 120
_MOVING_RGB, _PARKED_RGB, PICKED_RGB = (80, 255, 80), (255, 255, 255), (255, 140, 0)


def draw_overlay(scene: DrivingScene, view: RecordedView) -> UInt8[Tensor, "height width 3"]:
    """The recorded image with its frame's points coloured by depth and all boxes in view.

    Boxes stand where they are at the moment of the exposure: green moves, white is parked, the
    cross marks the front of the actor. Small images are enlarged, so that points do not hide them.
    """
    times = -(-_LEGEND_WIDTH_PX // view.camera.width_px)
    camera = view.camera.resized(
        width_px=times * view.camera.width_px, height_px=times * view.camera.height_px
    )
    image = cv2.resize(scene.read_image(view).numpy(), (camera.width_px, camera.height_px))
    if scene.sweeps_of(view.frame_index):
        _draw_points(image, camera, scene.read_positions(view.frame_index))
    draw_boxes(image, camera, scene.tracks, view.timestamp_ns)
    return torch.from_numpy(image)


def with_legend(overlay: UInt8[Tensor, "height width 3"]) -> UInt8[Tensor, "taller width 3"]:
    """The overlay over a strip that says what its colours mean."""
    image = overlay.numpy()
    strip = np.full((_LEGEND_PX, image.shape[1], 3), 30, np.uint8)
    ramp = np.tile(np.arange(_RAMP_PX) * 255 // _RAMP_PX, (12, 1)).astype(np.uint8)
    strip[8:20, 150 : 150 + _RAMP_PX] = cv2.applyColorMap(ramp, cv2.COLORMAP_TURBO)[..., ::-1]
    words = (
        (f"LiDAR points: {_NEAREST_M:g} m", 5, (255, 255, 255)),
        (f"{_FARTHEST_M:g} m", 158 + _RAMP_PX, (255, 255, 255)),
        ("box: moves", 330, _MOVING_RGB),
        ("box: parked", 430, _PARKED_RGB),
        ("crossed face: its front", 530, (255, 255, 255)),
    )
    for text, left, colour in words:
        cv2.putText(strip, text, (left, 19), cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)
    return torch.from_numpy(np.concatenate([image, strip]))


def draw_boxes(
    image: np.ndarray,
    camera: Camera,
    tracks: Sequence[ActorTrack],
    timestamp_ns: int,
    picked: Collection[str] = (),
) -> None:
    """Draw the actors that are there at a time over an image (height, width, 3; bytes).

    Those whose ids are picked are orange.
    """
    for track in tracks:
        if track.is_present(timestamp_ns):
            colour = _MOVING_RGB if track.is_moving else _PARKED_RGB
            if track.actor_id in picked:
                colour = PICKED_RGB
            _draw_box(image, camera, track, timestamp_ns, colour)


def _draw_points(image: np.ndarray, camera: Camera, xyz_m: Tensor) -> None:
    pixels_uv, depth_m = camera.project(xyz_m)
    seen = camera.contains(pixels_uv, depth_m)
    uv, depth = pixels_uv[seen].numpy(), depth_m[seen].numpy()
    scaled = np.log(depth / _NEAREST_M) / np.log(_FARTHEST_M / _NEAREST_M)
    shades = np.clip(255 * scaled, 0, 255).astype(np.uint8)[:, None]
    colours_bgr = cv2.applyColorMap(shades, cv2.COLORMAP_TURBO)[:, 0] if len(shades) else shades
    radius_px = max(1, camera.width_px // 960)
    for row in np.argsort(-depth):
        centre = int(uv[row, 0]), int(uv[row, 1])
        cv2.circle(image, centre, radius_px, colours_bgr[row, ::-1].tolist(), thickness=-1)


def _draw_box(
    image: np.ndarray,
    camera: Camera,
    track: ActorTrack,
    timestamp_ns: int,
    colour: tuple[int, int, int],
) -> None:
    world_from_box = track.pose_at(timestamp_ns)
    camera_from_box = invert_rigid(camera.world_from_camera) @ world_from_box
    corners = transform_points(camera_from_box, box_corners(track.size_m.double())).numpy()
    crossed = ((4, 7), (5, 6))  # the diagonals of the face at +x
    for first, second in (*BOX_EDGES, *crossed):
        _draw_line(image, camera, corners[first], corners[second], colour)


def _draw_line(
    image: np.ndarray,
    camera: Camera,
    start_m: np.ndarray,
    end_m: np.ndarray,
    colour: tuple[int, int, int],
) -> None:
    """Draw the part of a camera-frame segment that lies in front of the camera."""
    if start_m[2] < end_m[2]:
        start_m, end_m = end_m, start_m
    if start_m[2] <= _NEAR_PLANE_M:
        return
    if end_m[2] < _NEAR_PLANE_M:
        share = (start_m[2] - _NEAR_PLANE_M) / (start_m[2] - end_m[2])
        end_m = start_m + share * (end_m - start_m)
    pixels = [
        (
            round(camera.fx_px * point[0] / point[2] + camera.cx_px),
            round(camera.fy_px * point[1] / point[2] + camera.cy_px),
        )
        for point in (start_m, end_m)
    ]
    is_visible, first, second = cv2.clipLine(
        (0, 0, camera.width_px, camera.height_px), pixels[0], pixels[1]
    )
    if is_visible:
        cv2.line(image, first, second, colour, max(1, camera.width_px // 960), cv2.LINE_AA)
