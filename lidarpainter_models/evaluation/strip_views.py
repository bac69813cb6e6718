"""The views by which cameras left out of a fit judge it: see `strips` for what they measure."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.shown import ShownScene
from lidarpainter_models.evaluation.strips import (
    StripView,
    calibrate_strip,
    score_strips,
    strip_mask,
)
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.lidar.sparse_depth import FramePoints
from lidarpainter_models.observations.fit_size import fit_camera
from lidarpainter_models.scenes.splits import ViewSplit, evenly_taken

COMPARED_FRAMES = 3
"""Frames in which a judging camera looks for its neighbour: the rig does not change."""


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
            views = self._strip(fitted, camera, name, frames)
            return sum(int(strip_mask(view).sum()) for view in views)

        return max(self.fitted_cameras, key=num_shared)

    def _score(self, shown: ShownScene, camera: str) -> dict[str, Any]:
        neighbour = self.neighbour(shown.scene, camera)
        shows = shown.renderer(neighbour)

        def render(camera: Camera, timestamp_ns: int) -> Float[Tensor, "height width 3"]:
            return shows(camera, timestamp_ns).cpu()  # strips are cut and turned there

        def views_of(frames: tuple[int, ...]) -> list[StripView]:
            return self._strip(shown.scene, camera, neighbour, frames)

        try:
            calibration = calibrate_strip(render, views_of(self.views.train_frames))
            scores = score_strips(render, views_of(self.views.test_frames), calibration)
        except DataError as error:
            return {"psnr": None, "psnr_reason": str(error), "fitted_camera": neighbour}
        return asdict(scores) | {"fitted_camera": neighbour}

    def _strip(
        self, fitted: GaussianScene, camera: str, neighbour: str, frames: tuple[int, ...]
    ) -> list[StripView]:
        return strip_views(
            self.held_out,
            fitted,
            judging_camera=camera,
            fitted_camera=neighbour,
            frames=frames,
        )


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
    where the log says, moved as the fit moved the other camera, for the jitter of logged poses is
    the rig's. Frames that one of the two lacks, or that have no sweep, are left out.
    """
    scene, lidar = held_out.scene, FramePoints(held_out.scene)
    judging = {view.frame_index: view for view in scene.views_of(judging_camera)}
    fitting = {view.frame_index: view for view in scene.views_of(fitted_camera)}
    views = []
    for frame in frames:
        if frame not in judging or frame not in fitting or not scene.sweeps_of(frame):
            continue
        own, other = judging[frame], fitting[frame]
        logged = fit_camera(other, held_out.observation)
        found = fitted.refined_camera(other, logged)
        found_from_logged = found.world_from_camera @ invert_rigid(logged.world_from_camera)
        camera = fit_camera(own, held_out.observation)
        camera = camera.refined(found_from_logged @ camera.world_from_camera)
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
