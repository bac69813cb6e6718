"""The views by which cameras left out of a fit judge it: see `strips` for what they measure."""

from collections.abc import Iterable, Sequence

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.strips import StripView
from lidarpainter_models.gaussians.model.scene_graph import GaussianScene
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.observations.observations import fit_camera, shrink_image


def judging_cameras(held_out: HeldOut, fitted_cameras: Sequence[str]) -> tuple[str, ...]:
    """The scene's cameras that no fit has seen."""
    return tuple(name for name in held_out.scene.camera_names if name not in fitted_cameras)


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
    scene = held_out.scene
    judging = {view.frame_index: view for view in scene.views_of(judging_camera)}
    fitting = {view.frame_index: view for view in scene.views_of(fitted_camera)}
    views = []
    for frame in frames:
        if frame not in judging or frame not in fitting or not scene.sweeps_of(frame):
            continue
        own, other = judging[frame], fitting[frame]
        logged = fit_camera(other, held_out.observation)
        found = fitted.corrected_camera(
            logged, timestamp_ns=other.timestamp_ns, camera_name=fitted_camera, key=other.key
        )
        found_from_logged = found.world_from_camera @ invert_rigid(logged.world_from_camera)
        camera = fit_camera(own, held_out.observation)
        camera = camera.at(found_from_logged @ camera.world_from_camera)
        image = shrink_image(
            scene.read_image(own), width_px=camera.width_px, height_px=camera.height_px
        )
        views.append(
            StripView(
                camera=camera,
                timestamp_ns=own.timestamp_ns,
                truth_rgb=image.float() / 255,
                fitted_camera=found,
                points_world=held_out.points_at(own),
            )
        )
    return views
