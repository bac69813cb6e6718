"""What is asked for of a fitted scene along a path: the one request from a command to the files."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.followed_paths import (
    FollowedPath,
    followed_cameras,
    followed_views,
)
from lidarpainter_models.conditioning.sequences import SequencePainter
from lidarpainter_models.conditioning.settings import SequenceConfig
from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.trajectory_specs import Trajectory
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT, Painter
from lidarpainter_models.scenes.driving_scene import DrivingScene

RECORDING, UNPAINTED = "recorded", "unpainted"
"""What may be shown to the left, beside another scene of the same log."""
Images = Literal["rendered", "recorded"]


@dataclass(frozen=True, kw_only=True)
class ViewKinds:
    """Which files are wanted of every view."""

    images: bool = True
    """Whether the images themselves are written."""
    depth: bool = False
    """Whether camera z is written as 16-bit PNG, in 256ths of a metre."""
    semantics: bool = False
    """Whether who is where is written as 16-bit PNG, with a legend."""
    video: bool = False
    """Whether a film is written of each camera, and one of all."""
    fps: float | None = None
    """Images a second of the film; None takes those of the recording."""

    @property
    def has_poses(self) -> bool:
        """Whether files are written that say where each was taken from."""
        return self.images or self.depth or self.semantics


@dataclass(frozen=True, kw_only=True)
class ViewRequest:
    """Where to look from, what is seen there, and what of it is written."""

    trajectory: Trajectory
    """Where the camera goes, in steps off the path that it took."""
    camera: str | None = None
    """Whose path is followed: a name, several with commas, `all`, or None for the first fitted."""
    frames: slice | None = None
    """Positions of the recorded frames to follow; None follows all."""
    width_px: int | None = None
    """Width of the images, at most as recorded; None takes that of the fit."""
    is_painted: bool = False
    """Whether a painter paints every image; otherwise the scene is shown as it is."""
    painter: str | None = None
    """Name of the painter; None takes the run's own."""
    prompt: str = DEFAULT_PROMPT
    """What a painter that knows styles is asked for."""
    sequence: SequenceConfig = field(default_factory=SequenceConfig)
    """What becomes of the image painted before."""
    allows_collisions: bool = False
    """Whether the camera may go through what LiDAR saw standing there."""
    beside: str | None = None
    """What is shown to the left: `recorded`, `unpainted`, or another run of the same scene."""
    kinds: ViewKinds = field(default_factory=ViewKinds)
    """Which files are written of every view."""

    def __post_init__(self) -> None:
        """Refuse what nobody would paint.

        Raises:
            ConfigError: a prompt, the image before or unpainted images without a painter.
        """
        asked = {
            "--previous": self.sequence.previous != "unused",
            f"prompt {self.prompt!r}": self.prompt != DEFAULT_PROMPT,
            "--beside unpainted": self.beside == UNPAINTED,
        }
        if not self.is_painted and (idle := [name for name, is_asked in asked.items() if is_asked]):
            raise ConfigError(f"{idle[0]} needs a painter: --postpaint or --painter")


def followed_paths(
    request: ViewRequest,
    recorded: DrivingScene,
    builder: ConditionBuilder,
    *,
    fitted_cameras: Sequence[str],
    observation: ObservationConfig,
    load_painter: Callable[[], Painter],
) -> list[FollowedPath]:
    """What the images of a request are made from, a path for every camera.

    Args:
        request: where to look from, and whether images are painted.
        recorded: the recording that the scene was fitted to.
        builder: the fitted scene, and what is known of its views.
        fitted_cameras: names of the cameras that the fit saw.
        observation: how the images of the fit were made.
        load_painter: gives the painter; called where images are painted.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
        ConfigError: a path leads into a wall, or a scene in a style is to be painted.
    """
    views_of = [
        followed_views(recorded, name, request.frames)
        for name in followed_cameras(recorded, fitted_cameras, request.camera)
    ]
    observation = replace(observation, width_px=request.width_px or observation.width_px)
    style = builder.scene.style
    if request.is_painted and style is not None:
        raise ConfigError(
            f"the run is in the style {style.mix.text}, and painters know clear days: paint the "
            "run that it was derived from"
        )
    evidence = None
    if style is None and request.prompt == DEFAULT_PROMPT:  # a style has no true images
        evidence = EvidenceGatherer(builder.scene, builder.lidar_map, builder.training_views)
    paths = [
        FollowedPath(
            recorded=recorded,
            builder=builder,
            views=views,
            trajectory=request.trajectory,
            observation=observation,
            painter=_painter(request, builder, load_painter, views[0].camera_name),
            as_rig=len(views_of) > 1,
            evidence=evidence,
        )
        for views in views_of
    ]
    if not request.allows_collisions:
        for path in paths:
            path.refuse_walls()
    return paths


def _painter(
    request: ViewRequest,
    builder: ConditionBuilder,
    load_painter: Callable[[], Painter],
    camera_name: str,
) -> SequencePainter | None:
    """Paints the images of one camera in their order; None where images are not painted."""
    if not request.is_painted:
        return None
    return SequencePainter(
        builder,
        load_painter(),
        config=request.sequence,
        camera_name=camera_name,
        prompt=request.prompt,
    )


def only_path(paths: Sequence[FollowedPath], request: ViewRequest) -> FollowedPath:
    """The path of the one camera that is followed.

    Raises:
        ConfigError: several cameras are asked for.
    """
    if len(paths) > 1:
        raise ConfigError(f"--camera {request.camera}: expected one camera here")
    return paths[0]
