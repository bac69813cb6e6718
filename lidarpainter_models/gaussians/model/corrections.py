"""What a fit refines about the recorded cameras: poses and exposure. It changes them in place.

A camera's correction is a small rigid motion in the camera's own frame: a constant per camera
(extrinsic calibration) plus a part per training view. The views' parts of a camera sum to zero
(the mean is moved into the constant), so the two are told apart. Tangents are (rotation vector in
radians, translation in metres), float64, and stay on the CPU: a step reads one of them and sends a
4x4 to wherever the Gaussians are. Colours are changed where the image is.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.model.pose_blending import RefinedTracks
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.scenes.camera_faults import CameraFault
from lidarpainter_models.scenes.ego_corrections import EgoCorrections
from lidarpainter_models.scenes.records import ViewKey

GAIN_KNOTS_NS = 1_000_000_000
"""Between knots of a camera's gain: exposures are controlled slowly."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraCorrections:
    """Refined poses of the training views."""

    keys: tuple[ViewKey, ...]
    timestamps_ns: Int[Tensor, " views"]
    recorded_world_from_camera: Float[Tensor, "views 4 4"]
    view_tangent: Float[Tensor, "views 6"]
    camera_names: tuple[str, ...]
    camera_tangent: Float[Tensor, "cameras 6"]
    faults: Mapping[str, CameraFault] = field(default_factory=dict)
    """What was found wrong before the fit; `recorded_world_from_camera` is without it."""
    own_bodies: Mapping[str, Bool[Tensor, "height width"]] = field(default_factory=dict)
    """Where cameras show the recording car itself, at fit size, on the CPU."""
    path: EgoCorrections = field(default_factory=EgoCorrections.none)
    """Where the car drove; `recorded_world_from_camera` is as if it had been recorded."""

    @classmethod
    def none(
        cls,
        keys: Sequence[ViewKey],
        timestamps_ns: Int[Tensor, " views"],
        recorded_world_from_camera: Float[Tensor, "views 4 4"],
        faults: Mapping[str, CameraFault] | None = None,
        own_bodies: Mapping[str, Bool[Tensor, "height width"]] | None = None,
        path: EgoCorrections | None = None,
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
            faults=faults or {},
            own_bodies=own_bodies or {},
            path=path or EgoCorrections.none(),
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

    def refined(self, camera: Camera, key: ViewKey, timestamp_ns: int) -> Camera:
        """The camera of a recorded view at its refined pose.

        A training view has a pose of its own; at any other time it is blended from those of the
        same camera (see `pose_blending`). A camera never trained on stands where its recording
        and the sweeps say.
        """
        row, camera_name = self.row_of(key), key[1]
        camera = self.path.of_camera(camera, timestamp_ns)
        if camera_name in self.faults:
            camera = self.faults[camera_name].corrected(camera)
        if row is not None:
            with torch.no_grad():
                return camera.refined(self.world_from_camera(row))
        track = self.track_of(camera_name)
        if track is None:
            return camera
        pose = track.pose_at(0, timestamp_ns * 1e-9, camera.world_from_camera.double())
        return camera.refined(pose)

    def riding(
        self, camera: Camera, timestamp_ns: int, other: Camera, key: ViewKey, other_ns: int
    ) -> Camera:
        """A recorded camera that no fit saw, on the rig of one that a fit saw.

        It stands where the log and the sweeps say, moved as the fit moved the other camera: what is
        left of the jitter of logged poses is the rig's.

        Args:
            camera: as recorded.
            timestamp_ns: of its image.
            other: the camera that the fit saw, as recorded.
            key: of the view of the other camera.
            other_ns: the timestamp of that view.
        """
        found = self.refined(other, key, other_ns).world_from_camera.double()
        logged = self.path.of_camera(other, other_ns).camera_from_world.double()
        own = self.path.of_camera(camera, timestamp_ns)
        return own.refined(found @ logged @ own.world_from_camera.double())

    def tensors(self) -> dict[str, Tensor]:
        """Everything to be stored besides keys and names."""
        names = ("timestamps_ns", "recorded_world_from_camera", "view_tangent", "camera_tangent")
        return {name: getattr(self, name) for name in names}

    def recentre(self) -> None:
        """Move the mean of each camera's view corrections into its constant; no pose changes."""
        with torch.no_grad():
            for index, rows in enumerate(self._rows_of_cameras):
                mean = self.view_tangent[rows].mean(dim=0)
                self.view_tangent[rows] -= mean
                self.camera_tangent[index] += mean


@dataclass(frozen=True, eq=False, kw_only=True)
class ExposureCorrections:
    """Colours as a camera shows them: shown = gain(time) * matrix @ rgb + offset.

    The gain follows what a camera does to its exposure during a log; over its knots the mean of its
    logarithm is held at 0, so that the matrix alone says how cameras differ. Few numbers, which
    stay on the CPU wherever the Gaussians lie.
    """

    camera_names: tuple[str, ...]
    matrix: Float[Tensor, "cameras 3 4"]
    """The offset is the last column."""
    knots_ns: Int[Tensor, " knots"]
    """Evenly spaced."""
    log_gain: Float[Tensor, "cameras knots"]
    """Linear in time between knots."""

    @classmethod
    def none(
        cls, camera_names: Sequence[str], timestamps_ns: Sequence[int]
    ) -> "ExposureCorrections":
        """Colours as they are, in a log with images of these times."""
        first_ns, last_ns = min(timestamps_ns), max(timestamps_ns)
        count = 1 + math.ceil((last_ns - first_ns) / GAIN_KNOTS_NS)
        steps = torch.arange(count) * ((last_ns - first_ns) // max(count - 1, 1))
        return cls(
            camera_names=tuple(camera_names),
            matrix=torch.eye(3, 4).repeat(len(camera_names), 1, 1),
            knots_ns=first_ns + steps,
            log_gain=torch.zeros(len(camera_names), count),
        )

    @classmethod
    def measured(
        cls,
        camera_names: Sequence[str],
        names: Sequence[str],
        timestamps_ns: Sequence[int],
        shown: Float[Tensor, "images 3"],
    ) -> "ExposureCorrections":
        """As images show the colours of the scene, by channel; one of every camera at least.

        What a camera's images depart from their median is the gain's, the rest the matrix'.
        """
        exposure = cls.none(camera_names, timestamps_ns)
        for row, name in enumerate(camera_names):
            own = sorted(
                (index for index, one in enumerate(names) if one == name),
                key=lambda index: timestamps_ns[index],
            )
            log_shown, times_ns = shown[own].log(), [timestamps_ns[index] for index in own]
            departure = (log_shown - log_shown.median(dim=0).values).mean(dim=1)
            gain = np.interp(exposure.knots_ns, times_ns, departure)
            gain -= gain.mean()
            exposure.log_gain[row] = torch.from_numpy(gain)
            at_images = torch.from_numpy(np.interp(times_ns, exposure.knots_ns, gain)).float()
            rest = log_shown - at_images[:, None]
            exposure.matrix[row, :, :3] = rest.median(dim=0).values.exp().diag()
        return exposure

    def neighbours(self, timestamp_ns: int) -> tuple[int, int, float]:
        """The knots before and after a time, and the weight of the later one."""
        last = self.knots_ns.numel() - 1
        span_ns = max(int(self.knots_ns[-1] - self.knots_ns[0]), 1)
        place = (timestamp_ns - int(self.knots_ns[0])) / span_ns * last
        place = min(max(place, 0.0), float(last))
        before = min(int(place), max(last - 1, 0))
        return before, min(before + 1, last), place - before

    def apply(
        self, rgb: Float[Tensor, "height width 3"], camera_name: str | None, timestamp_ns: int
    ) -> Float[Tensor, "height width 3"]:
        """The image as this camera exposes it then; unchanged for a camera never trained on."""
        exposure = self.map_at(camera_name, timestamp_ns)
        if exposure is None:
            return rgb
        exposure = exposure.to(rgb.device)
        return rgb @ exposure[:, :3].T + exposure[:, 3]

    def undone(
        self, rgb: Float[Tensor, "height width 3"], camera_name: str, timestamp_ns: int
    ) -> Float[Tensor, "height width 3"]:
        """A recorded image in the colours of the scene itself; no gradient."""
        with torch.no_grad():
            exposure = self.map_at(camera_name, timestamp_ns)
            if exposure is None:
                return rgb
            inverse, offset = torch.linalg.inv(exposure[:, :3]).T, exposure[:, 3]
            return (rgb - offset.to(rgb.device)) @ inverse.to(rgb.device)

    def map_at(self, camera_name: str | None, timestamp_ns: int) -> Float[Tensor, "3 4"] | None:
        """How this camera exposes colours then, what is added last; None for a strange camera."""
        if camera_name is None or camera_name not in self.camera_names:
            return None
        row = self.camera_names.index(camera_name)
        before, after, weight = self.neighbours(timestamp_ns)
        log_gain = (1 - weight) * self.log_gain[row, before] + weight * self.log_gain[row, after]
        matrix, offset = self.matrix[row, :, :3], self.matrix[row, :, 3:]
        return torch.cat([log_gain.exp() * matrix, offset], dim=1)
