"""Undo lens distortion, so that everything after the store sees pinhole cameras.

Models and coefficients are OpenCV's: `brown` (radial and tangential) and `fisheye` (Kannala and
Brandt, 2006). OpenCV puts the centre of the first pixel at 0, the project at 0.5.
"""

from dataclasses import replace

import cv2
import numpy as np

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.records import Distortion


def _matrix(camera: Camera) -> np.ndarray:
    """OpenCV's camera matrix, whose principal point counts from the first pixel's centre."""
    return np.array(
        [
            [camera.fx_px, 0.0, camera.cx_px - 0.5],
            [0.0, camera.fy_px, camera.cy_px - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )


def pinhole_of(lens: Camera, distortion: Distortion) -> Camera:
    """The pinhole camera of the undistorted image: same size, no empty border.

    Raises:
        ConfigError: no such camera exists.
    """
    if distortion.model == "none":
        return lens
    size_px = (lens.width_px, lens.height_px)
    terms = np.array(distortion.terms)
    if distortion.model == "brown":
        matrix, _ = cv2.getOptimalNewCameraMatrix(_matrix(lens), terms, size_px, alpha=0.0)
    else:
        matrix = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
            _matrix(lens), terms, size_px, np.eye(3), balance=0.0
        )
    return replace(
        lens,
        fx_px=float(matrix[0, 0]),
        fy_px=float(matrix[1, 1]),
        cx_px=float(matrix[0, 2]) + 0.5,
        cy_px=float(matrix[1, 2]) + 0.5,
    )


def undistort(
    image: np.ndarray, lens: Camera, distortion: Distortion, pinhole: Camera
) -> np.ndarray:
    """The image (height, width, 3) as the pinhole camera would have taken it."""
    if distortion.model == "none":
        return image
    size_px = (pinhole.width_px, pinhole.height_px)
    undistortion = (
        cv2.initUndistortRectifyMap
        if distortion.model == "brown"
        else cv2.fisheye.initUndistortRectifyMap
    )
    map_x, map_y = undistortion(
        _matrix(lens),
        np.array(distortion.terms),
        np.eye(3),
        _matrix(pinhole),
        size_px,
        cv2.CV_32FC1,
    )
    return cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR)
