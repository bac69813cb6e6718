"""What is corrected about the recorded cameras: poses and exposure. A fit changes it in place.

A camera's correction is a small rigid motion in the camera's own frame: a constant per camera
(extrinsic calibration) plus a part per training view. The views' parts of a camera sum to zero
(the mean is moved into the constant), so the two are told apart. Tangents are (rotation vector in
radians, translation in metres), float64, and stay on the CPU: a step reads one of them and sends a
4x4 to wherever the Gaussians are. Colours are changed where the image is.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.model.pose_blending import RefinedTracks
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.scenes.records import ViewKey


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraCorrections:
    """Refined poses of the training views."""

    keys: tuple[ViewKey, ...]
    timestamps_ns: Int[Tensor, " views"]
    recorded_world_from_camera: Float[Tensor, "views 4 4"]
    view_tangent: Float[Tensor, "views 6"]
    camera_names: tuple[str, ...]
    camera_tangent: Float[Tensor, "cameras 6"]

    @classmethod
    def none(
        cls,
        keys: Sequence[ViewKey],
        timestamps_ns: Int[Tensor, " views"],
        recorded_world_from_camera: Float[Tensor, "views 4 4"],
    ) -> "CameraCorrections":
        """Nothing corrected yet."""
        names = tuple(sorted({name for _, name in keys}))
        return cls(
            keys=tuple(keys),
            timestamps_ns=timestamps_ns,
            recorded_world_from_camera=recorded_world_from_camera.double(),
            view_tangent=torch.zeros(len(keys), 6, dtype=torch.float64),
            camera_names=names,
            camera_tangent=torch.zeros(len(names), 6, dtype=torch.float64),
        )

    @cached_property
    def _rows_of_cameras(self) -> tuple[Int[Tensor, " _"], ...]:
        """The training views of each camera."""
        found: dict[str, list[int]] = {name: [] for name in self.camera_names}
        for row, (_, name) in enumerate(self.keys):
            found[name].append(row)
        return tuple(torch.tensor(rows, dtype=torch.int64) for rows in found.values())

    def row_of(self, key: ViewKey) -> int | None:
        """The training view's position, or None if it was not trained on."""
        return self.keys.index(key) if key in self.keys else None

    def tangent(self, row: int) -> Float[Tensor, "6"]:
        """A training view's whole correction; differentiable."""
        camera = self.camera_names.index(self.keys[row][1])
        return self.camera_tangent[camera] + self.view_tangent[row]

    def world_from_camera(self, row: int) -> Float[Tensor, "4 4"]:
        """A training view's refined pose; differentiable."""
        return self.recorded_world_from_camera[row] @ rigid_from_tangent(self.tangent(row))

    def track_of(self, camera_name: str) -> RefinedTracks | None:
        """Recorded and refined poses of one camera in order of time; None if never trained on."""
        rows = [row for row, key in enumerate(self.keys) if key[1] == camera_name]
        if not rows:
            return None
        rows.sort(key=lambda row: int(self.timestamps_ns[row]))
        with torch.no_grad():
            refined = torch.stack([self.world_from_camera(row) for row in rows])
        times_s = self.timestamps_ns[rows].double() * 1e-9
        return RefinedTracks.of([times_s], [self.recorded_world_from_camera[rows]], [refined])

    def corrected(
        self, camera: Camera, *, key: ViewKey | None, timestamp_ns: int, camera_name: str
    ) -> Camera:
        """The camera at its most likely pose; a camera never trained on stays as recorded."""
        row = None if key is None else self.row_of(key)
        if row is not None:
            with torch.no_grad():
                return camera.at(self.world_from_camera(row))
        track = self.track_of(camera_name)
        if track is None:
            return camera
        return camera.at(track.pose_at(0, timestamp_ns * 1e-9, camera.world_from_camera.double()))

    def tensors(self) -> dict[str, Tensor]:
        """Everything to be stored besides keys and names."""
        names = ("timestamps_ns", "recorded_world_from_camera", "view_tangent", "camera_tangent")
        return {name: getattr(self, name) for name in names}

    def recentre(self, *, keep_mean: bool) -> None:
        """Take the mean off each camera's view corrections, in place.

        With `keep_mean` it goes into the camera's constant, so that no pose changes.
        """
        with torch.no_grad():
            for index, rows in enumerate(self._rows_of_cameras):
                mean = self.view_tangent[rows].mean(dim=0)
                self.view_tangent[rows] -= mean
                if keep_mean:
                    self.camera_tangent[index] += mean


@dataclass(frozen=True, eq=False, kw_only=True)
class ExposureCorrections:
    """An affine map of colours per camera: shown = matrix @ (rgb, 1)."""

    camera_names: tuple[str, ...]
    matrix: Float[Tensor, "cameras 3 4"]

    @classmethod
    def none(cls, camera_names: Sequence[str]) -> "ExposureCorrections":
        """Colours as they are."""
        return cls(
            camera_names=tuple(camera_names),
            matrix=torch.eye(3, 4).repeat(len(camera_names), 1, 1),
        )

    def to(self, device: torch.device) -> "ExposureCorrections":
        """The same on another device."""
        return replace(self, matrix=self.matrix.to(device))

    def apply(
        self, rgb: Float[Tensor, "height width 3"], camera_name: str | None
    ) -> Float[Tensor, "height width 3"]:
        """The image as this camera exposes it; unchanged for a camera never trained on."""
        if camera_name is None or camera_name not in self.camera_names:
            return rgb
        matrix = self.matrix[self.camera_names.index(camera_name)]
        return rgb @ matrix[:, :3].T + matrix[:, 3]
