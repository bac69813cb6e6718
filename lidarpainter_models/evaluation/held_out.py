"""Held-out views of a scene, at recorded poses, at interpolated poses, and beside the path.

No image and no sweep of a held-out frame was used for fitting. `interpolated` poses come from
the refined training poses around the frame and from where its own sweep says that the car was
(`lidar.sweep_registration`), so no test image enters them; `recorded` poses are the log's own. The
two are reported side by side and never mixed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from lidarpainter_models.evaluation.view_scores import NOBODY, ScoredView, actors_in_view
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.geometry.trajectories import road_directions, shift_pose
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.points_on_actors import MovingBoxes
from lidarpainter_models.observations.image_shrinking import fit_camera, shrink_image
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene, RecordedView
from lidarpainter_models.scenes.records import ViewKey
from lidarpainter_models.scenes.splits import sampled_views
from lidarpainter_models.synthetic.street import SyntheticStreet

Poses = Literal["interpolated", "recorded"]


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """What a fitted scene is judged on."""

    scene: DrivingScene
    test_views: Sequence[RecordedView]
    observation: ObservationConfig
    _images_u8: dict[ViewKey, UInt8[Tensor, "height width 3"]] = field(
        default_factory=dict, repr=False, compare=False
    )

    @cached_property
    def _moving(self) -> MovingBoxes:
        return MovingBoxes([track for track in self.scene.tracks if track.is_moving])

    @cached_property
    def _directions(self) -> Float[Tensor, "frames 3"]:
        return road_directions(self.scene.world_from_ego)

    def sampled(self, most_views: int) -> "HeldOut":
        """With so many of the views at most, each camera's evenly over time; 0 keeps all."""
        if most_views == 0 or len(self.test_views) <= most_views:
            return self
        return replace(self, test_views=sampled_views(self.test_views, most_views))

    def image_of(self, view: RecordedView) -> Float[Tensor, "height width 3"]:
        """The recorded image at fit size, decoded at the first call."""
        if view.key not in self._images_u8:
            camera = fit_camera(view, self.observation)
            self._images_u8[view.key] = shrink_image(
                self.scene.read_image(view), width_px=camera.width_px, height_px=camera.height_px
            )
        return self._images_u8[view.key].float() / 255

    def camera_of(self, fitted: GaussianScene, view: RecordedView, poses: Poses) -> Camera:
        """The view's camera at fit size, at its recorded or its interpolated pose."""
        camera = fit_camera(view, self.observation)
        if poses == "recorded":
            return camera
        return fitted.refined_camera(view, camera)

    def shifted_camera(
        self, fitted: GaussianScene, view: RecordedView, shift: Shift, poses: Poses = "interpolated"
    ) -> Camera:
        """The camera of a view moved beside the path."""
        camera = self.camera_of(fitted, view, poses)
        direction = self._directions[self.scene.frame_position(view.frame_index)]
        return camera.at(shift_pose(camera.world_from_camera, direction, shift))

    def recorded_views(self, fitted: GaussianScene, poses: Poses) -> list[ScoredView]:
        """The held-out images."""
        bodies = fitted.cameras.own_bodies
        images = side_by_side(self.image_of, self.test_views)
        return [
            self._judged(
                view, self.camera_of(fitted, view, poses), image, bodies.get(view.camera_name)
            )
            for view, image in zip(self.test_views, images, strict=True)
        ]

    def synthetic_views(
        self, fitted: GaussianScene, street: SyntheticStreet, shift: Shift
    ) -> list[ScoredView]:
        """Exact images of the synthetic street beside the path, at the held-out times."""
        judged = []
        for view in self.test_views:
            camera = self.shifted_camera(fitted, view, shift)
            judged.append(self._judged(view, camera, street.render(camera, view.timestamp_ns).rgb))
        return judged

    def _judged(
        self,
        view: RecordedView,
        camera: Camera,
        truth_rgb: Float[Tensor, "height width 3"],
        hidden: Bool[Tensor, "height width"] | None = None,
    ) -> ScoredView:
        taken_ns = camera.taken_ns(view.timestamp_ns)
        actor_ids, actor_index = actors_in_view(camera, self._moving, taken_ns)
        if hidden is not None:
            actor_index[hidden] = NOBODY
        return ScoredView(
            name=f"{view.camera_name}/{view.frame_index}",
            camera=camera,
            timestamp_ns=view.timestamp_ns,
            truth_rgb=truth_rgb,
            actor_ids=actor_ids,
            actor_index=actor_index,
            hidden=hidden,
        )
