"""Undo lens distortion, so that everything after the store sees pinhole cameras.

Models and coefficients are OpenCV's: `brown` (radial and tangential), `fisheye` (Kannala and
Brandt, 2006) and `mei` (the unified omnidirectional model of Mei and Rives, 2007). OpenCV puts the
centre of the first pixel at 0, the project at 0.5.

A pinhole cannot show 180 degrees, and a polynomial that turns back shows some directions twice:
where the whole image would need either, the pinhole shows the middle of it, `WIDEST_DEG` across at
most.
"""

import math
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.records import Distortion

WIDEST_DEG = 130.0
"""Across a pinhole image, at most: at 130 degrees its border has a fifth of the middle's detail."""
NARROWEST_DEG = 25.0
"""A lens of which no more can be shown is none."""
_BORDER_POINTS = 32  # along each side: between two of them a lens bends by far less than a pixel
_STEPS = 40  # of a bisection: a focal length to twelve digits


def pinhole_of(lens: Camera, distortion: Distortion) -> Camera:
    """The pinhole camera of the undistorted image: same size, no empty border.

    Raises:
        ConfigError: no such camera exists.
    """
    if distortion.model == "none":
        return lens
    found = _pinhole_intrinsics(_intrinsics(lens), lens.width_px, lens.height_px, distortion)
    return _with_intrinsics(lens, found)


Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy in pixels."""


def _intrinsics(camera: Camera) -> Intrinsics:
    return camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px


def _with_intrinsics(camera: Camera, intrinsics: Intrinsics) -> Camera:
    fx_px, fy_px, cx_px, cy_px = (float(number) for number in intrinsics)
    return replace(camera, fx_px=fx_px, fy_px=fy_px, cx_px=cx_px, cy_px=cy_px)


@lru_cache(maxsize=64)
def _pinhole_intrinsics(
    intrinsics: Intrinsics, width_px: int, height_px: int, distortion: Distortion
) -> Intrinsics:
    """The intrinsics of `pinhole_of`, found once for all images of a camera."""
    fx_px, fy_px, cx_px, cy_px = intrinsics
    lens = Camera(
        world_from_camera=torch.eye(4, dtype=torch.float64),
        fx_px=fx_px,
        fy_px=fy_px,
        cx_px=cx_px,
        cy_px=cy_px,
        width_px=width_px,
        height_px=height_px,
    )
    matrix = _whole_image_matrix(lens, distortion)
    if matrix is not None and min(matrix[0, 0], matrix[1, 1]) > 0:
        middle = matrix[:2, 2] + 0.5
        whole = _with_intrinsics(lens, (matrix[0, 0], matrix[1, 1], middle[0], middle[1]))
        if _is_bounded(whole) and _is_single(whole, distortion):
            return _intrinsics(whole)
    return _intrinsics(_middle(lens, distortion))


def undistort(
    image: UInt8[np.ndarray, "height width 3"],
    lens: Camera,
    distortion: Distortion,
    pinhole: Camera,
) -> UInt8[np.ndarray, "height width 3"]:
    """The image as the pinhole camera would have taken it."""
    if distortion.model == "none":
        return image
    size_px = (pinhole.width_px, pinhole.height_px)
    terms, kind = np.array(distortion.terms), cv2.CV_32FC1
    matrices = _matrix(lens), np.eye(3), _matrix(pinhole)
    if distortion.model == "mei":
        how = cv2.omnidir.RECTIFY_PERSPECTIVE
        maps = cv2.omnidir.initUndistortRectifyMap(
            matrices[0], terms[1:], terms[:1], *matrices[1:], size_px, kind, how
        )
    elif distortion.model == "brown":
        maps = cv2.initUndistortRectifyMap(matrices[0], terms, *matrices[1:], size_px, kind)
    else:
        maps = cv2.fisheye.initUndistortRectifyMap(matrices[0], terms, *matrices[1:], size_px, kind)
    return cv2.remap(image, *maps, cv2.INTER_LINEAR)


def _matrix(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """OpenCV's camera matrix, whose principal point counts from the first pixel's centre."""
    return np.array(
        [
            [camera.fx_px, 0.0, camera.cx_px - 0.5],
            [0.0, camera.fy_px, camera.cy_px - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )


def _whole_image_matrix(lens: Camera, distortion: Distortion) -> Float[np.ndarray, "3 3"] | None:
    """OpenCV's pinhole that shows as much as it can of the whole image; it has none for `mei`."""
    size_px, terms = (lens.width_px, lens.height_px), np.array(distortion.terms)
    if distortion.model == "mei":
        return None
    if distortion.model == "brown":
        return cv2.getOptimalNewCameraMatrix(_matrix(lens), terms, size_px, alpha=0.0)[0]
    return cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
        _matrix(lens), terms, size_px, np.eye(3), balance=0.0
    )


def _is_bounded(pinhole: Camera) -> bool:
    """Whether a pinhole shows at most `WIDEST_DEG` in either direction, its axis in the image."""
    sides = (
        (pinhole.cx_px, pinhole.width_px, pinhole.fx_px),
        (pinhole.cy_px, pinhole.height_px, pinhole.fy_px),
    )
    most = math.tan(math.radians(WIDEST_DEG / 2))
    return all(0 < middle < size and size / 2 / focal <= most for middle, size, focal in sides)


def _border(pinhole: Camera) -> Float[np.ndarray, "points 3"]:
    """Directions through the border of a pinhole's image, z = 1."""
    along = np.linspace(0.0, 1.0, _BORDER_POINTS)
    zero, one = np.zeros_like(along), np.ones_like(along)
    sides = [(along, zero), (along, one), (zero, along), (one, along)]
    u, v = (np.concatenate(parts) for parts in zip(*sides, strict=True))
    x = (u * pinhole.width_px - pinhole.cx_px) / pinhole.fx_px
    y = (v * pinhole.height_px - pinhole.cy_px) / pinhole.fy_px
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def _is_single(pinhole: Camera, distortion: Distortion) -> bool:
    """Whether every direction of a pinhole's image falls farther out than those inside it."""
    border = _border(pinhole)
    farthest = np.arctan(np.linalg.norm(border[:, :2], axis=1).max())
    radii = _radii(np.linspace(0.0, farthest, 256), distortion)
    return bool(np.isfinite(radii).all() and (np.diff(radii) > 0).all())


def _radii(
    angles_rad: Float[np.ndarray, " angles"], distortion: Distortion
) -> Float[np.ndarray, " angles"]:
    """How far from the centre directions fall, by their angle from the axis; radial terms alone."""
    terms = distortion.terms
    if distortion.model == "fisheye":
        k1, k2, k3, k4 = terms
        squared = angles_rad**2
        return angles_rad * (1 + squared * (k1 + squared * (k2 + squared * (k3 + squared * k4))))
    if distortion.model == "mei":
        xi, k1, k2 = terms[:3]
        radius = np.sin(angles_rad) / (np.cos(angles_rad) + xi)
        return radius * (1 + k1 * radius**2 + k2 * radius**4)
    radius = np.tan(angles_rad)
    k = (*terms[:2], *terms[4:], *(0.0,) * (8 - len(terms)))  # k1 k2 k3 k4 k5 k6
    squared = radius**2
    above = 1 + squared * (k[0] + squared * (k[1] + squared * k[2]))
    return radius * above / (1 + squared * (k[3] + squared * (k[4] + squared * k[5])))


def _landed(
    directions: Float[np.ndarray, "points 3"], lens: Camera, distortion: Distortion
) -> Float[np.ndarray, "points 2"]:
    """Where directions fall in the recorded image, pixels, the first one's centre at 0.5."""
    points, none = directions.reshape(-1, 1, 3), np.zeros(3)
    terms = np.array(distortion.terms)
    if distortion.model == "mei":
        found, _ = cv2.omnidir.projectPoints(
            points, none, none, _matrix(lens), float(terms[0]), terms[1:]
        )
    elif distortion.model == "brown":
        found, _ = cv2.projectPoints(points, none, none, _matrix(lens), terms)
    else:
        found, _ = cv2.fisheye.projectPoints(points, none, none, _matrix(lens), terms)
    return found.reshape(-1, 2) + 0.5


def _middle(lens: Camera, distortion: Distortion) -> Camera:
    """The widest pinhole of which every pixel falls into the image, once."""
    longer_px = max(lens.width_px, lens.height_px)
    centred = replace(lens, cx_px=lens.width_px / 2, cy_px=lens.height_px / 2)

    def of_width(degrees: float) -> Camera:
        focal_px = longer_px / 2 / math.tan(math.radians(degrees / 2))
        return replace(centred, fx_px=focal_px, fy_px=focal_px)

    def fits(degrees: float) -> bool:
        pinhole = of_width(degrees)
        if not _is_single(pinhole, distortion):
            return False
        u, v = _landed(_border(pinhole), lens, distortion).T
        inside = (u >= 0) & (u <= lens.width_px) & (v >= 0) & (v <= lens.height_px)
        return bool(inside.all())

    if not fits(NARROWEST_DEG):
        raise ConfigError(
            f"a {distortion.model} lens with the terms {distortion.terms} shows less than "
            f"{NARROWEST_DEG:g} degrees of its image once"
        )
    low, high = NARROWEST_DEG, WIDEST_DEG
    if fits(high):
        return of_width(high)
    for _ in range(_STEPS):
        middle = (low + high) / 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return of_width(low)
