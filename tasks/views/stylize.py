"""Images of a finished run in another weather or at night."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from lidarpainter_models.conditioning.followed_paths import FollowedPath, image_record
from lidarpainter_models.conditioning.style_views import style_view
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.export.images import write_png
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.lidar.sky_masks import sky_mask
from lidarpainter_models.metrics.edges import edge_agreement, mean_edge_scores
from lidarpainter_models.observations.fit_size import shrink_image
from lidarpainter_models.painter.styles import StyleView, apply_mix
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.weather.mix import StyleMix
from tasks.json_files import write_json
from tasks.progress import listener
from tasks.specs import FittedRef, RunSpec
from tasks.stages import stage_task
from tasks.views.render import POSES_FILE, RenderRequest, followed_path

STAGE = "stylize"
RECORDED = "recorded"
CLEAR_FOLDER = "clear"

Images = Literal["rendered", "recorded"]


@dataclass(frozen=True, kw_only=True)
class StylizeRequest:
    """Which images are wanted, and in which style."""

    mix: StyleMix
    view: RenderRequest
    images: Images = "rendered"
    """Style what the scene shows, or what the camera recorded where it stood."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse recorded images from where nobody stood.

        Raises:
            ConfigError: they are asked for.
        """
        if self.images not in ("rendered", RECORDED):
            raise ConfigError(f"no images {self.images!r}, expected rendered or recorded")
        if self.images == RECORDED and (
            not self.view.trajectory.is_recorded or self.view.is_painted
        ):
            raise ConfigError("recorded images exist on the recorded trajectory, unpainted")


@stage_task
def stylize(run: RunSpec, fitted: FittedRef, request: StylizeRequest, out: Path) -> dict[str, Any]:
    """Write a styled image for every recorded moment, the clear one beside it.

    Returns:
        Where the images are and how well their edges are those of the clear ones.

    Raises:
        SceneError: the run did not train on that camera, or no frame is left.
        ConfigError: what the scene shows is in a style already.
    """
    path = followed_path(run, fitted, request.view)
    style = path.builder.scene.style
    if style is not None and request.images != RECORDED:
        raise ConfigError(
            f"the run is in the style {style.mix.text}, and styles are put on clear days: stylize "
            "the run that it was derived from, or --images recorded"
        )
    listener().started(STAGE)
    times_ns = path.recorded.frame_timestamps_ns
    first_ns, span_ns = int(times_ns[0]), max(int(times_ns[-1] - times_ns[0]), 1)
    rows, scores = [], []
    for number, moment in enumerate(path.views):
        camera = path.camera(number)
        view, lidar_depth_m = _view(path, camera, moment, request.images)
        # every frame has its own drops and noise, and the same ones each time
        generator = torch.Generator().manual_seed((request.seed << 32) + moment.frame_index)
        passed = (moment.timestamp_ns - first_ns) / span_ns
        styled = apply_mix(view, request.mix, generator, progress=passed)
        file = write_png(styled, out / f"{moment.frame_index:04d}.png")
        write_png(view.rgb, out / CLEAR_FOLDER / file.name)
        agreement = edge_agreement(styled, view.rgb, lidar_depth_m)
        kept = None if agreement is None else asdict(agreement)
        rows.append({**image_record(file.name, camera, moment), "edges": kept})
        scores += [] if agreement is None else [agreement]
        listener().advanced(STAGE, number + 1, len(path.views), "")
    described = {"trajectory": request.view.trajectory.spec, "prompt": request.mix.text}
    write_json(out / POSES_FILE, {**described, "seed": request.seed, "images": rows})
    return {
        "folder": str(out),
        "num_images": len(rows),
        "camera": path.views[0].camera_name,
        **mean_edge_scores(scores),
    }


def _view(
    path: FollowedPath, camera: Camera, moment: RecordedView, images: Images
) -> tuple[StyleView, torch.Tensor]:
    """The clear image with depth and sky, and its LiDAR depth."""
    if images == "rendered":
        rgb, sky = path.image(camera, moment), None
    else:
        size = {"width_px": camera.width_px, "height_px": camera.height_px}
        rgb_u8 = shrink_image(path.recorded.read_image(moment), **size)
        points_world = path.recorded.read_positions(moment.frame_index)
        rgb, sky = rgb_u8.float() / 255, sky_mask(rgb_u8, points_world, camera)
    return style_view(path.builder, camera, moment.timestamp_ns, rgb, sky)
