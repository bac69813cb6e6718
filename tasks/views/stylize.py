"""Images of a finished run in another weather or at night."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import torch
from prefect import task

from catalog.store import open_store
from lidarpainter_models.conditioning.style_views import style_view
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.export.images import write_png
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.lidar.sky_masks import sky_mask
from lidarpainter_models.metrics.edges import EdgeConfig, EdgeScores, edge_agreement
from lidarpainter_models.observations.observations import shrink_image
from lidarpainter_models.painter.styles import StyleConfig, StyleView, apply_style, check_prompt
from lidarpainter_models.scenes.records import RecordedView
from tasks.json_files import write_json
from tasks.progress import listener
from tasks.runs import FinishedRun
from tasks.stages import STAGE_OPTIONS
from tasks.views.render import POSES_FILE, OpenedRun, RenderRequest, image_record, open_views

STAGE = "stylize"
RECORDED = "recorded"
CLEAR_FOLDER = "clear"

Images = Literal["rendered", "recorded"]


@dataclass(frozen=True, kw_only=True)
class StylizeRequest:
    """Which images are wanted, and in which style."""

    prompt: str
    """One of `STYLE_PROMPTS`."""
    view: RenderRequest
    images: Images = "rendered"
    """Style what the scene shows, or what the camera recorded where it stood."""
    seed: int = 0
    style: StyleConfig = field(default_factory=StyleConfig)
    edges: EdgeConfig = field(default_factory=EdgeConfig)

    def __post_init__(self) -> None:
        """Refuse styles that are none, and recorded images from where nobody stood.

        Raises:
            ConfigError: one of these.
        """
        check_prompt(self.prompt)
        if self.images not in ("rendered", RECORDED):
            raise ConfigError(f"no images {self.images!r}, expected rendered or recorded")
        if self.images == RECORDED and (
            self.view.trajectory.spec != RECORDED or self.view.painter is not None
        ):
            raise ConfigError("recorded images exist on the recorded trajectory, unpainted")


@task(**STAGE_OPTIONS)
def stylize(
    store_path: Path, run: FinishedRun, request: StylizeRequest, out: Path
) -> dict[str, Any]:
    """Write a styled image for every recorded moment, the clear one beside it.

    Returns:
        Where the images are and how well their edges are those of the clear ones.

    Raises:
        SceneError: the run did not train on that camera, or no frame is left.
    """
    opened = open_views(open_store(store_path), run, request.view)
    listener().started(STAGE)
    rows, scores = [], []
    for number, moment in enumerate(opened.views):
        camera = opened.camera(number)
        view, lidar_depth_m = _view(opened, camera, moment, request.images)
        # every frame has its own drops and noise, and the same ones each time
        generator = torch.Generator().manual_seed((request.seed << 32) + moment.frame_index)
        styled = apply_style(view, request.prompt, generator, request.style)
        name = f"{moment.frame_index:04d}.png"
        path = write_png(styled, out / name)
        write_png(view.rgb, out / CLEAR_FOLDER / name)
        agreement = edge_agreement(styled, view.rgb, lidar_depth_m, request.edges)
        kept = None if agreement is None else asdict(agreement)
        rows.append({**image_record(path, camera, moment), "edges": kept})
        scores += [] if agreement is None else [agreement]
        listener().advanced(STAGE, number + 1, len(opened.views), "")
    described = {"trajectory": request.view.trajectory.spec, "prompt": request.prompt}
    write_json(out / POSES_FILE, {**described, "seed": request.seed, "images": rows})
    return {
        "folder": str(out),
        "num_images": len(rows),
        "camera": opened.camera_name,
        **_means(scores),
    }


def _view(
    opened: OpenedRun, camera: Camera, moment: RecordedView, images: Images
) -> tuple[StyleView, torch.Tensor]:
    """The clear image with depth and sky, and its LiDAR depth."""
    if images == "rendered":
        rgb, sky = opened.image(camera, moment), None
    else:
        size = {"width_px": camera.width_px, "height_px": camera.height_px}
        rgb = shrink_image(opened.recorded.read_image(moment), **size).float() / 255
        sky = sky_mask(opened.recorded, moment, camera)
    return style_view(opened.builder, camera, moment.timestamp_ns, rgb, sky)


def _means(scores: list[EdgeScores]) -> dict[str, float | None]:
    """Of all images; None where no image has edges near LiDAR hits."""
    return {
        f"edge_{name}": fmean(getattr(score, name) for score in scores) if scores else None
        for name in ("f1", "precision", "recall", "judged_share")
    }
