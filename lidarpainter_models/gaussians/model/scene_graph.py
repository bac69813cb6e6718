"""A dynamic scene: street Gaussians, rigid actors, sky, and what was corrected about the cameras.

A Gaussian of an actor sits in the actor's box frame; at a time its centre and covariance are
carried by the actor's pose, mu = R_t mu_v + t_t and Sigma = R_t Sigma_v R_t^T (Street Gaussians,
Yan et al. 2024). Actors absent at that time are left out. Camera frame: x right, y down, z
forward; world: z up; metres.
"""

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.gaussians.model.actor_motions import PRESENCE_MARGIN_NS, ActorMotions
from lidarpainter_models.gaussians.model.corrections import (
    ActorCorrections,
    CameraCorrections,
    ExposureCorrections,
)
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.seen_gaussians import SeenGaussians
from lidarpainter_models.gaussians.model.sky import SkyTexture
from lidarpainter_models.gaussians.model.sky_sampling import SkyLayout
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_tangent
from lidarpainter_models.kernels.backends import Backend
from lidarpainter_models.kernels.gaussian_raster import SplatImage, render_gaussians
from lidarpainter_models.scenes.driving_scene import ActorTrack
from lidarpainter_models.scenes.records import ViewKey
from lidarpainter_models.scenes.stored_tracks import tracks_from_arrays, tracks_to_arrays

OPAQUE = 1 - 1 / 512
"""From this opacity on the sky is not looked up: it would change no byte by more than half."""
_FAR_BEHIND_M = -1e6
SCHEMA = 1


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneRender:
    """One rendered view."""

    rgb: Float[Tensor, "height width 3"]
    """Gaussians over sky, not clamped above 1."""
    depth_m: Float[Tensor, "height width"]
    """Expected camera z of what is seen; 0 where the Gaussians cover less than half."""
    alpha: Float[Tensor, "height width"]
    """Opacity of the Gaussians, before the sky."""
    actor_alpha: Float[Tensor, "height width"]
    """The part of alpha that belongs to actors."""


@dataclass(eq=False, kw_only=True)
class GaussianScene:
    """Everything needed to draw the scene at any pose and time of the log."""

    gaussians: GaussianSet
    recorded_tracks: tuple[ActorTrack, ...]
    """Body i + 1 is the i-th of these."""
    sky: SkyTexture
    cameras: CameraCorrections
    actors: ActorCorrections
    exposure: ExposureCorrections
    _recorded_poses: dict[int, tuple[Tensor, Tensor]] = field(default_factory=dict, repr=False)
    _motions_made: ActorMotions | None = field(default=None, repr=False)

    @property
    def num_gaussians(self) -> int:
        """How many Gaussians there are."""
        return len(self.gaussians)

    @property
    def tracks(self) -> tuple[ActorTrack, ...]:
        """The actors' tracks with refined poses."""
        motions = self._motions()
        return tuple(
            replace(
                track,
                world_from_box=torch.stack(
                    [motions.pose_at(index, int(time_ns)) for time_ns in track.timestamps_ns]
                ),
            )
            for index, track in enumerate(self.recorded_tracks)
        )

    def actor_poses(
        self, timestamp_ns: int
    ) -> tuple[Float[Tensor, "actors 4 4"], Float[Tensor, " actors"]]:
        """Most likely actor poses at any time, and 1 for each actor present then, else 0.

        At training times these are the refined poses; in between see `pose_blending`.
        """
        motions, (recorded, present) = self._motions(), self._recorded_at(timestamp_ns)
        poses = recorded.clone()
        for index in present.nonzero()[:, 0].tolist():
            poses[index] = motions.pose_at(index, timestamp_ns)
        return poses, present

    def world_from_actors(
        self, timestamp_ns: int
    ) -> tuple[Float[Tensor, "actors 4 4"], Float[Tensor, " actors"]]:
        """Corrected actor poses at a time, differentiable, and 1 for each actor present then."""
        recorded, present = self._recorded_at(timestamp_ns)
        return recorded @ rigid_from_tangent(self.actors.at(timestamp_ns)), present

    def _recorded_at(
        self, timestamp_ns: int
    ) -> tuple[Float[Tensor, "actors 4 4"], Float[Tensor, " actors"]]:
        if timestamp_ns not in self._recorded_poses:
            self._recorded_poses[timestamp_ns] = _poses_at(self.recorded_tracks, timestamp_ns)
        return self._recorded_poses[timestamp_ns]

    def _motions(self) -> ActorMotions:
        """The actors' refined motions, made again when the corrections have changed."""
        tangent = self.actors.tangent.detach()
        if self._motions_made is None or not torch.equal(self._motions_made.tangent, tangent):
            self._motions_made = ActorMotions.of(self.recorded_tracks, self.actors)
        return self._motions_made

    def camera_from_body(
        self,
        world_from_camera: Float[Tensor, "4 4"],
        world_from_actors: Float[Tensor, "actors 4 4"],
        present: Float[Tensor, " actors"],
    ) -> Float[Tensor, "bodies 4 4"]:
        """Where every body stands in the camera; differentiable in the poses, float32.

        Absent actors are put far behind the camera, where nothing is drawn.
        """
        camera_from_world = invert_rigid(world_from_camera.double())
        if not self.recorded_tracks:
            return camera_from_world[None].float()
        absent = torch.eye(4, dtype=torch.float64)
        absent[2, 3] = _FAR_BEHIND_M
        is_present = present[:, None, None] > 0
        camera_from_actor = torch.where(is_present, camera_from_world @ world_from_actors, absent)
        return torch.cat([camera_from_world[None], camera_from_actor]).float()

    def splat(
        self,
        camera: Camera,
        camera_from_body: Float[Tensor, "bodies 4 4"],
        *,
        gaussians: GaussianSet | SeenGaussians | None = None,
        with_actor_alpha: bool = False,
        screen_gradient_out: Float[Tensor, " gaussians"] | None = None,
        backend: Backend = "auto",
    ) -> SplatImage:
        """Blend the Gaussians (or given ones in their place) into the camera, without sky."""
        chosen = self.gaussians if gaussians is None else gaussians
        is_actor = (chosen.body_index > 0).float()[:, None] if with_actor_alpha else None
        return render_gaussians(
            chosen.means,
            chosen.rotation_wxyz,
            chosen.scale_m,
            chosen.opacity,
            chosen.sh,
            chosen.body_index,
            camera_from_body.to(chosen.means.device),
            fx_px=camera.fx_px,
            fy_px=camera.fy_px,
            cx_px=camera.cx_px,
            cy_px=camera.cy_px,
            width_px=camera.width_px,
            height_px=camera.height_px,
            features=is_actor,
            screen_gradient_out=screen_gradient_out,
            backend=backend,
        )

    def render(
        self,
        camera: Camera,
        timestamp_ns: int,
        *,
        camera_name: str | None = None,
        view_key: ViewKey | None = None,
        backend: Backend = "auto",
    ) -> SceneRender:
        """Draw the view of `camera`, taken as it stands, at a time.

        With `view_key` (a training view) the camera is first moved to its refined pose; with
        `camera_name` the colours are exposed as that camera's.
        """
        row = None if view_key is None else self.cameras.row_of(view_key)
        with torch.no_grad():
            if row is not None:
                camera = camera.at(self.cameras.world_from_camera(row))
            bodies = self.camera_from_body(
                camera.world_from_camera, *self.actor_poses(timestamp_ns)
            )
            image = self.splat(camera, bodies, with_actor_alpha=True, backend=backend)
            clear = (1 - image.alpha)[..., None]
            rgb = image.rgb + clear * self.sky.sample(self.sky.rays(camera, image.alpha < OPAQUE))
            depth_m = expected_depth(image.depth_m, image.alpha)
            return SceneRender(
                rgb=self.exposure.apply(rgb, camera_name),
                depth_m=torch.where(image.alpha >= 0.5, depth_m, torch.zeros_like(depth_m)),
                alpha=image.alpha,
                actor_alpha=image.features[..., 0],
            )

    def corrected_camera(
        self,
        camera: Camera,
        *,
        timestamp_ns: int,
        camera_name: str,
        key: ViewKey | None = None,
    ) -> Camera:
        """A recorded camera at its refined pose.

        A training view gets its own correction, any other time one interpolated from the training
        views of the same camera (see `pose_blending`); a camera never trained on stays as it is.
        """
        return self.cameras.corrected(
            camera, key=key, timestamp_ns=timestamp_ns, camera_name=camera_name
        )

    def to_arrays(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Arrays and JSON-able metadata of the whole scene; `from_arrays` inverts it bitwise."""
        track_arrays, track_records = tracks_to_arrays(self.recorded_tracks)
        cameras = self.cameras
        groups: dict[str, dict[str, Tensor]] = {
            "gaussians": self.gaussians.columns(),
            "sky": self.sky.tensors(),
            "tracks": track_arrays,
            "cameras": cameras.tensors(),
            "actors": {"knots_ns": self.actors.knots_ns, "tangent": self.actors.tangent},
            "exposure": {"matrix": self.exposure.matrix},
        }
        arrays = {
            f"{group}.{name}": value.detach().cpu().contiguous()
            for group, columns in groups.items()
            for name, value in columns.items()
        }
        metadata = {
            "schema": SCHEMA,
            "tracks": track_records,
            "view_keys": [list(key) for key in cameras.keys],
            "camera_names": list(cameras.camera_names),
            "exposure_camera_names": list(self.exposure.camera_names),
            "sky_layout": asdict(self.sky.layout),
        }
        return arrays, metadata

    @classmethod
    def from_arrays(cls, arrays: dict[str, Tensor], metadata: dict[str, Any]) -> "GaussianScene":
        """Rebuild a stored scene.

        Raises:
            SceneError: the arrays were written by another version or are incomplete.
        """
        if metadata.get("schema") != SCHEMA:
            raise SceneError(
                f"a stored Gaussian scene has schema {metadata.get('schema')}, this version reads "
                f"{SCHEMA}: fit it again"
            )
        groups: dict[str, dict[str, Tensor]] = {}
        for name, value in arrays.items():
            group, _, column = name.partition(".")
            groups.setdefault(group, {})[column] = value
        try:
            return cls(
                gaussians=GaussianSet(**groups["gaussians"]),
                recorded_tracks=tracks_from_arrays(groups["tracks"], metadata["tracks"]),
                sky=SkyTexture(layout=SkyLayout(**metadata["sky_layout"]), **groups["sky"]),
                cameras=CameraCorrections(
                    keys=tuple((int(frame), str(name)) for frame, name in metadata["view_keys"]),
                    camera_names=tuple(metadata["camera_names"]),
                    **groups["cameras"],
                ),
                actors=ActorCorrections(**groups["actors"]),
                exposure=ExposureCorrections(
                    camera_names=tuple(metadata["exposure_camera_names"]), **groups["exposure"]
                ),
            )
        except (KeyError, TypeError) as error:
            raise SceneError(f"a stored Gaussian scene is incomplete: {error}") from error

    def copy(self) -> "GaussianScene":
        """The same scene, sharing no memory and collecting no gradients."""
        arrays, metadata = self.to_arrays()
        return self.from_arrays({name: value.clone() for name, value in arrays.items()}, metadata)

    def with_gaussians(self, gaussians: GaussianSet) -> "GaussianScene":
        """The same scene with other Gaussians."""
        return replace(self, gaussians=gaussians)


def expected_depth(
    accumulated_m: Float[Tensor, "height width"], alpha: Float[Tensor, "height width"]
) -> Float[Tensor, "height width"]:
    """Accumulated depth divided by the opacity it was accumulated over."""
    return accumulated_m / alpha.clamp(min=1e-4)


def _poses_at(
    tracks: tuple[ActorTrack, ...], timestamp_ns: int
) -> tuple[Float[Tensor, "actors 4 4"], Float[Tensor, " actors"]]:
    """Recorded poses at a time and 1 where the actor is present."""
    if not tracks:
        return torch.zeros(0, 4, 4, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    poses = torch.stack([track.pose_at(timestamp_ns).double() for track in tracks])
    present = [track.is_present(timestamp_ns, PRESENCE_MARGIN_NS) for track in tracks]
    return poses, torch.tensor(present, dtype=torch.float64)


def describe(scene: GaussianScene) -> dict[str, Any]:
    """Counts worth reporting."""
    body = scene.gaussians.body_index
    return {
        "num_gaussians": len(scene.gaussians),
        "num_actor_gaussians": int((body > 0).sum()),
        "num_actors": len(scene.recorded_tracks),
        "sky_texels": [scene.sky.layout.rows, scene.sky.layout.columns],
    }
