"""Cross-camera strips: real images of a view that lies beside the fitted one.

A camera left out of training sees part of the same surfaces from elsewhere. Before it may judge,
two constants per camera are fitted on *training* frames: a rotation (mounts are calibrated to
about half a degree) and an affine colour (exposures differ). Then held-out frames are scored on
the strip: pixels whose LiDAR surface the fitted camera sees as well.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.shown import ShownScene
from lidarpainter_models.evaluation.view_scores import Renderer
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rigid_from_tangent, rotation_from_vector
from lidarpainter_models.kernels.point_splat import splat_points
from lidarpainter_models.lidar.sparse_depth import FramePoints
from lidarpainter_models.metrics.depth import visible_points
from lidarpainter_models.metrics.images import (
    MIN_PIXELS,
    apply_affine_colour,
    fit_affine_colour,
    psnr_from_error,
    squared_error,
)
from lidarpainter_models.observations.image_shrinking import fit_camera
from lidarpainter_models.scenes.splits import ViewSplit, evenly_taken

GROW_PX = 1
"""The strip mask is grown by this much around its LiDAR pixels."""
SAME_SURFACE = 0.05
"""A point is seen by the other camera when its z-buffer lies within 5 % of the point's depth."""
DIFFERENCE_STEP_RAD = 5e-4
"""Slopes are taken over about a quarter pixel: bilinear images are not smooth below that."""
MAX_ROTATION_RAD = 0.03
"""A fitted rotation at this bound means that the fit failed."""
COMPARED_FRAMES = 3
"""Frames in which a judging camera looks for its neighbour: the rig does not change."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StripView:
    """One image of the judging camera, and the fitted camera of the same frame."""

    camera: Camera
    timestamp_ns: int
    truth_rgb: Float[Tensor, "height width 3"]
    fitted_camera: Camera
    points_world: Float[Tensor, "points 3"]


@dataclass(frozen=True, slots=True, kw_only=True)
class StripCalibration:
    """What differs by mount and exposure, fitted on training frames."""

    rotation_rad: tuple[float, float, float]
    """Rotation vector in the judging camera's frame."""
    affine: tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class StripScores:
    """PSNR pooled over the pixels of all frames."""

    psnr: float
    """On the strip, after calibration."""
    uncalibrated_psnr: float
    """On the strip, of the images as they are rendered and delivered."""
    whole_image_psnr: float
    """The same, on all pixels, also those that no fitted camera saw."""
    num_views: int
    num_pixels: int
    calibration: StripCalibration


def strip_mask(view: StripView) -> Bool[Tensor, "height width"]:
    """Pixels of the judging camera whose LiDAR surface both cameras see, grown a little."""
    pixels, depth_m = visible_points(view.camera, view.points_world)
    columns, rows = pixels[:, 0].long(), pixels[:, 1].long()
    depth_map = torch.zeros(view.camera.height_px, view.camera.width_px)
    depth_map[rows, columns] = depth_m
    world = view.camera.unproject(depth_map)[rows, columns]
    uv, other_m = view.fitted_camera.project(world)
    inside = view.fitted_camera.contains(uv, other_m)
    seen, seen_m = visible_points(view.fitted_camera, view.points_world)
    if len(seen) == 0:
        return torch.zeros_like(depth_map, dtype=torch.bool)
    nearest = splat_points(
        seen,
        seen_m,
        height_px=view.fitted_camera.height_px,
        width_px=view.fitted_camera.width_px,
        radius_px=2,
    )
    size = torch.tensor([view.fitted_camera.width_px - 1, view.fitted_camera.height_px - 1])
    cell = torch.minimum(uv.nan_to_num().clamp(min=0).long(), size)
    index = nearest[cell[:, 1], cell[:, 0]].long()
    front_m = seen_m[index.clamp(min=0)]
    same = inside & (index >= 0) & ((other_m - front_m).abs() <= SAME_SURFACE * front_m)
    mask = np.zeros(depth_map.shape, np.uint8)
    mask[rows[same].numpy(), columns[same].numpy()] = 1
    kernel = np.ones((2 * GROW_PX + 1, 2 * GROW_PX + 1), np.uint8)
    return torch.from_numpy(cv2.dilate(mask, kernel).astype(bool))


def render_at_fitted_detail(render: Renderer, view: StripView) -> Float[Tensor, "height width 3"]:
    """Render the judging camera, box-averaged from about as many pixels a degree as were fitted.

    Gaussians are made for the pixels they were fitted to: finer ones cost 1.5 dB (a synthetic
    street, a second camera half a metre aside, whose own pixels are as fine), and side cameras
    with half as many a degree lose up to 0.6 dB if they are not rendered finer (PandaSet 002).
    """
    camera = view.camera
    times = max(1, round(view.fitted_camera.fx_px / camera.fx_px))
    fine = camera.resized(width_px=camera.width_px * times, height_px=camera.height_px * times)
    image = render(fine, view.timestamp_ns).clamp(0, 1).permute(2, 0, 1)[None]
    return torch.nn.functional.avg_pool2d(image, times)[0].permute(1, 2, 0)


def rotate_image(
    rgb: Float[Tensor, "height width 3"], camera: Camera, rotation_rad: np.ndarray
) -> np.ndarray:
    """What the camera would show when turned: a pure rotation is a homography."""
    rotation = rotation_from_vector(torch.from_numpy(np.asarray(rotation_rad))).numpy()
    intrinsics = np.array(
        [[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1.0]]
    )
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # OpenCV's pixel centres are whole
    turned = half @ intrinsics @ rotation @ np.linalg.inv(half @ intrinsics)
    return cv2.warpPerspective(
        rgb.numpy(),
        turned,
        (camera.width_px, camera.height_px),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )


def calibrate_strip(render: Renderer, views: Sequence[StripView]) -> StripCalibration:
    """Fit one rotation and one affine colour on training frames.

    Raises:
        DataError: the two cameras share too few pixels, or no small rotation explains them.
    """
    images = [render_at_fitted_detail(render, view) for view in views]
    masks = [strip_mask(view) for view in views]
    if sum(int(mask.sum()) for mask in masks) < MIN_PIXELS:
        raise DataError("the judging camera shares too few LiDAR surfaces with the fitted one")
    truth = torch.cat([view.truth_rgb[mask] for view, mask in zip(views, masks, strict=True)])

    def turned_pixels(rotation_rad: np.ndarray) -> Tensor:
        turned = [
            torch.from_numpy(rotate_image(image, view.camera, rotation_rad))[mask]
            for image, view, mask in zip(images, views, masks, strict=True)
        ]
        return torch.cat(turned)

    def residuals(rotation_rad: np.ndarray) -> np.ndarray:
        rendered = turned_pixels(rotation_rad)
        affine = fit_affine_colour(rendered, truth)
        return (apply_affine_colour(rendered, affine) - truth).numpy().ravel()

    def slopes(rotation_rad: np.ndarray) -> np.ndarray:
        steps = DIFFERENCE_STEP_RAD * np.eye(3)
        ahead = [residuals(rotation_rad + step) for step in steps]
        behind = [residuals(rotation_rad - step) for step in steps]
        return (np.stack(ahead, axis=1) - np.stack(behind, axis=1)) / (2 * DIFFERENCE_STEP_RAD)

    best = least_squares(
        residuals, np.zeros(3), jac=slopes, loss="soft_l1", f_scale=0.05, x_scale=2e-3
    )
    if np.abs(best.x).max() > MAX_ROTATION_RAD:
        raise DataError(
            f"no rotation under {MAX_ROTATION_RAD} rad explains the judging camera, got {best.x}"
        )
    affine = fit_affine_colour(turned_pixels(best.x), truth)
    about_x, about_y, about_z = best.x.tolist()
    return StripCalibration(
        rotation_rad=(about_x, about_y, about_z), affine=tuple(map(tuple, affine.tolist()))
    )


def score_strips(
    render: Renderer, views: Sequence[StripView], calibration: StripCalibration
) -> StripScores:
    """Score held-out frames of the judging camera on the strip."""
    affine = torch.tensor(calibration.affine)
    turn = rigid_from_tangent(
        torch.tensor([*calibration.rotation_rad, 0.0, 0.0, 0.0], dtype=torch.float64)
    )
    raw_error = calibrated_error = whole_error = 0.0
    num_pixels = num_whole = 0
    for view in views:
        mask = strip_mask(view)
        raw = render_at_fitted_detail(render, view)
        turned_camera = view.camera.refined(view.camera.world_from_camera @ turn)
        turned_view = replace(view, camera=turned_camera)
        turned = apply_affine_colour(render_at_fitted_detail(render, turned_view), affine)
        wrong = squared_error(raw, view.truth_rgb).double()
        raw_error += float(wrong[mask].sum())
        whole_error += float(wrong.sum())
        calibrated_error += float(squared_error(turned, view.truth_rgb)[mask].double().sum())
        num_pixels += int(mask.sum())
        num_whole += mask.numel()
    if num_pixels == 0:
        raise DataError("the judging camera shares no LiDAR surface with the fitted one")
    return StripScores(
        psnr=psnr_from_error(calibrated_error / num_pixels),
        uncalibrated_psnr=psnr_from_error(raw_error / num_pixels),
        whole_image_psnr=psnr_from_error(whole_error / num_whole),
        num_views=len(views),
        num_pixels=num_pixels,
        calibration=calibration,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class StripEvaluation:
    """How fitted scenes are held against the cameras that their fit did not see."""

    held_out: HeldOut
    views: ViewSplit

    @property
    def fitted_cameras(self) -> tuple[str, ...]:
        """The scene's cameras that the fit has seen."""
        fitted = {view.camera_name for view in self.views.train}
        return tuple(name for name in self.held_out.scene.camera_names if name in fitted)

    @property
    def cameras(self) -> tuple[str, ...]:
        """The scene's cameras that no fit has seen."""
        fitted = self.fitted_cameras
        return tuple(name for name in self.held_out.scene.camera_names if name not in fitted)

    def scores(self, shown: ShownScene, progress: Callable[[int, int], None]) -> dict[str, Any]:
        """Every camera's scores in the colours of its neighbour, or why there are none."""
        scores = {}
        for done, name in enumerate(self.cameras, start=1):
            scores[name] = self._score(shown, name)
            progress(done, len(self.cameras))
        return scores

    def neighbour(self, fitted: GaussianScene, camera: str) -> str:
        """The fitted camera that sees most of what a judging camera sees, in a few frames."""
        frames = tuple(evenly_taken(self.views.train_frames, COMPARED_FRAMES))

        def num_shared(name: str) -> int:
            views = strip_views(
                self.held_out, fitted, judging_camera=camera, fitted_camera=name, frames=frames
            )
            return sum(int(strip_mask(view).sum()) for view in views)

        return max(self.fitted_cameras, key=num_shared)

    def _score(self, shown: ShownScene, camera: str) -> dict[str, Any]:
        neighbour = self.neighbour(shown.scene, camera)
        shows = shown.renderer(neighbour)

        def render(camera: Camera, timestamp_ns: int) -> Float[Tensor, "height width 3"]:
            return shows(camera, timestamp_ns).cpu()  # strips are cut and turned there

        views_of = partial(
            strip_views, self.held_out, shown.scene, judging_camera=camera, fitted_camera=neighbour
        )
        try:
            calibration = calibrate_strip(render, views_of(frames=self.views.train_frames))
            scores = score_strips(render, views_of(frames=self.views.test_frames), calibration)
        except DataError as error:
            return {"psnr": None, "psnr_reason": str(error), "fitted_camera": neighbour}
        return asdict(scores) | {"fitted_camera": neighbour}


def strip_views(
    held_out: HeldOut,
    fitted: GaussianScene,
    *,
    judging_camera: str,
    fitted_camera: str,
    frames: Iterable[int],
) -> list[StripView]:
    """One camera's images at some frames, beside the fitted camera of the same frames.

    The fitted camera stands where the fit found it: at its own pose in training frames, between
    its neighbours' in others. The judging camera, at fit size, rides on the same rig: it stands
    where the log says, moved as the fit moved the other camera (`CameraCorrections.riding`). Frames
    that one of the two lacks, or that have no sweep, are left out.
    """
    scene = held_out.scene
    lidar = FramePoints(scene.corrected(fitted.cameras.path))
    judging = {view.frame_index: view for view in scene.views_of(judging_camera)}
    fitting = {view.frame_index: view for view in scene.views_of(fitted_camera)}
    views = []
    for frame in frames:
        if frame not in judging or frame not in fitting or not scene.sweeps_of(frame):
            continue
        own, other = judging[frame], fitting[frame]
        logged = fit_camera(other, held_out.observation)
        found = fitted.refined_camera(other, logged)
        camera = fitted.cameras.riding(
            fit_camera(own, held_out.observation),
            own.timestamp_ns,
            logged,
            other.key,
            other.timestamp_ns,
        )
        views.append(
            StripView(
                camera=camera,
                timestamp_ns=own.timestamp_ns,
                truth_rgb=held_out.image_of(own),
                fitted_camera=found,
                points_world=lidar.at_exposure(own),
            )
        )
    return views
