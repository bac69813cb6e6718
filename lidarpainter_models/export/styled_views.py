"""Images along a path in another weather or at night, each beside the clear one."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from lidarpainter_models.conditioning.followed_paths import FollowedPath, image_record
from lidarpainter_models.conditioning.scene_styles import style_view
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.export.images import write_png
from lidarpainter_models.export.view_files import recorded_u8
from lidarpainter_models.export.view_requests import RECORDING, Images, ViewRequest
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.lidar.sky_masks import sky_mask
from lidarpainter_models.metrics.edges import edge_agreement, mean_edge_scores
from lidarpainter_models.painter.styles import StyleView, apply_mix
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.weather.mix import StyleMix

CLEAR_FOLDER = "clear"


@dataclass(frozen=True, kw_only=True)
class StyleRequest:
    """Which images are styled, and how."""

    mix: StyleMix
    """The styles and their strengths."""
    images: Images = "rendered"
    """Style what the scene shows, or what the camera recorded where it stood."""
    seed: int = 0
    """Decides lit windows, puddles, drops and noise."""

    def __post_init__(self) -> None:
        """Refuse other images.

        Raises:
            ConfigError: they are asked for.
        """
        if self.images not in ("rendered", RECORDING):
            raise ConfigError(f"no images {self.images!r}, expected rendered or recorded")

    def check(self, view: ViewRequest) -> None:
        """Refuse recorded images from where nobody stood.

        Raises:
            ConfigError: they are asked for.
        """
        if self.images == RECORDING and (not view.trajectory.is_recorded or view.is_painted):
            raise ConfigError("recorded images exist on the recorded trajectory, unpainted")


def write_styled(
    path: FollowedPath, request: StyleRequest, out: Path, advanced: Callable[[int], None]
) -> tuple[list[dict[str, Any]], dict[str, float | None]]:
    """Write a styled image for every moment of a path, and the clear one to `clear/`.

    Args:
        path: where to look from.
        request: which images, and their style.
        out: folder for the images.
        advanced: told how many views are done.

    Returns:
        A row for each image as JSON, and how well edges are kept, means over images.

    Raises:
        ConfigError: what the scene shows is in a style already.
    """
    style = path.builder.scene.style
    if style is not None and request.images != RECORDING:
        raise ConfigError(
            f"the run is in the style {style.mix.text}, and styles are put on clear days: stylize "
            "the run that it was derived from, or --images recorded"
        )
    times_ns = path.recorded.frame_timestamps_ns
    first_ns, span_ns = int(times_ns[0]), max(int(times_ns[-1] - times_ns[0]), 1)
    rows, scores = [], []
    for number, moment in enumerate(path.views):
        camera = path.camera(number)
        view, lidar_depth_m = _view(path, camera, moment, request.images)
        # every frame has its own drops and noise, and the same ones each time; puddles stay
        generator = torch.Generator().manual_seed((request.seed << 32) + moment.frame_index)
        passed = (moment.timestamp_ns - first_ns) / span_ns
        styled = apply_mix(view, request.mix, generator, progress=passed, place_seed=request.seed)
        file = write_png(styled, out / f"{moment.frame_index:04d}.png")
        write_png(view.rgb, out / CLEAR_FOLDER / file.name)
        agreement = edge_agreement(styled, view.rgb, lidar_depth_m)
        kept = None if agreement is None else asdict(agreement)
        rows.append({**image_record(file.name, camera, moment), "edges": kept})
        scores += [] if agreement is None else [agreement]
        advanced(number + 1)
    return rows, mean_edge_scores(scores)


def _view(
    path: FollowedPath, camera: Camera, moment: RecordedView, images: Images
) -> tuple[StyleView, torch.Tensor]:
    """The clear image with depth and sky, and its LiDAR depth."""
    if images == "rendered":
        rgb, sky = path.shown(camera, moment).rgb, None
    else:
        rgb_u8 = recorded_u8(path, camera, moment)
        points_world = path.recorded.read_positions(moment.frame_index)
        rgb, sky = rgb_u8.float() / 255, sky_mask(rgb_u8, points_world, camera)
    return style_view(path.builder, camera, moment.timestamp_ns, rgb, sky)
