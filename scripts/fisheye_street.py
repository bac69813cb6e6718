"""A street some of whose cameras have fisheyes: pixels that are right, by a lens that is stored.

A fisheye sees too much for one pinhole image, so each is sampled from two exact ones that look 45
degrees to its left and right. What is stored says the lens (OpenCV's model `fisheye`: Kannala and
Brandt, 2006). Camera: x right, y down, z forward.
"""

from dataclasses import replace
from math import pi

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.records import Distortion
from lidarpainter_models.synthetic.street import SyntheticStreet
from lidarpainter_models.synthetic.truth import TrueImage

TERMS = (-0.02, 0.002, 0.0, 0.0)
FOCAL_PER_WIDTH = 0.42
"""Pixels per radian in the middle over the width of the image: 140 degrees across with `TERMS`."""
SAMPLES_PER_AXIS = 3
"""Each pixel is the mean of the square of it."""
FACE_REACH = (1.02, 1.16)
"""How far a pinhole image reaches to the sides, up and down, in focal lengths."""


class FisheyeStreet(SyntheticStreet):
    """A street whose cameras named ...fisheye have one, 140 degrees across a wide image."""

    def distortion(self, name: str) -> Distortion:
        """That of a fisheye for those named so."""
        return Distortion("fisheye", TERMS) if _is_fisheye(name) else Distortion()

    def camera(self, name: str, timestamp_ns: int) -> Camera:
        """A camera of the rig; of a fisheye the lens without its distortion."""
        camera = super().camera(name, timestamp_ns)
        if not _is_fisheye(name):
            return camera
        focal_px = FOCAL_PER_WIDTH * camera.width_px
        return replace(camera, fx_px=focal_px, fy_px=focal_px)

    def render_recorded(self, name: str, timestamp_ns: int) -> TrueImage:
        """What a camera sees; a fisheye's image has no depth or classes of its own."""
        if not _is_fisheye(name):
            return super().render_recorded(name, timestamp_ns)
        lens = self.camera(name, timestamp_ns)
        rays = self._rays(lens)
        rgb = np.empty((*rays.shape[:2], 3), np.float32)
        for side in (-1, 1):
            image, places = self._face(lens, timestamp_ns, side, rays)
            seen = cv2.remap(image, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
            is_there = side * rays[..., 0] >= 0
            rgb[is_there] = seen[is_there]
        rgb = cv2.resize(rgb, (lens.width_px, lens.height_px), interpolation=cv2.INTER_AREA)
        none = torch.zeros(rgb.shape[:2])
        return TrueImage(
            rgb=torch.from_numpy(rgb),
            depth_m=none,
            semantics=none.int(),
            actor_index=none.int() - 1,
        )

    def _rays(self, lens: Camera) -> NDArray[np.float64]:
        """Where every sample of a fisheye's pixels looks to, in its own frame."""
        scale = SAMPLES_PER_AXIS
        grid = np.indices((scale * lens.height_px, scale * lens.width_px))[::-1]
        pixels = ((grid + 0.5) / scale).transpose(1, 2, 0).reshape(-1, 1, 2)
        matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
        rays = cv2.fisheye.undistortPoints(pixels, matrix, np.array(TERMS))
        return np.asarray(rays, np.float64).reshape(*grid.shape[1:], 2)

    def _face(
        self, lens: Camera, timestamp_ns: int, side: int, rays: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """A pinhole image half to a side, a sample per pixel, and where in it the rays fall."""
        turn = _turned(side * pi / 4)
        pinhole = Camera.centred(
            lens.world_from_camera @ torch.from_numpy(turn),
            SAMPLES_PER_AXIS * lens.fx_px,
            width_px=2 * round(FACE_REACH[0] * SAMPLES_PER_AXIS * lens.fx_px),
            height_px=2 * round(FACE_REACH[1] * SAMPLES_PER_AXIS * lens.fx_px),
        )
        sparse = SyntheticStreet(replace(self.config, samples_per_axis=1))
        image = sparse.render(pinhole, timestamp_ns).rgb.numpy()
        ahead = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1) @ turn[:3, :3]
        middle = np.array([pinhole.cx_px, pinhole.cy_px]) - 0.5
        places = ahead[..., :2] / np.maximum(ahead[..., 2:], 1e-3) * pinhole.fx_px + middle
        return image, places.astype(np.float32)


def _is_fisheye(name: str) -> bool:
    return name.endswith("fisheye")


def _turned(angle_rad: float) -> Float[np.ndarray, "4 4"]:
    """A camera's frame turned to its right by an angle."""
    turn = np.eye(4)
    turn[0, 0] = turn[2, 2] = np.cos(angle_rad)
    turn[0, 2], turn[2, 0] = np.sin(angle_rad), -np.sin(angle_rad)
    return turn
