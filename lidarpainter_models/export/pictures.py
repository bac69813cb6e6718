"""Pictures of the report: before and after painting, a drive in motion, the worst views."""

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.scene_evaluation import known_street
from lidarpainter_models.evaluation.shown import ViewTimePainting
from lidarpainter_models.export.images import read_image, small_image, to_bytes, write_jpeg
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.metrics.images import score_image

PANEL_WIDTH_PX = 360
MOVING_QUALITY = 60
MOST_MOMENTS = 40
"""Of a moving picture, from the middle of the log; four seconds at 10 Hz."""
SHORTEST_MS = 40
MOST_LOOKED_AT = 24
"""Views that are rendered to find the worst, spread over all."""
NUM_WORST = 3
THUMBNAIL_WIDTH_PX = 400
"""Of each half, where many runs are shown on one page."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """One view before and after beside the truth, with the images it was made from."""

    title: str
    before_rgb: Float[Tensor, "height width 3"]
    after_rgb: Float[Tensor, "height width 3"]
    truth_rgb: Float[Tensor, "height width 3"] | None = None
    """None where nobody took an image."""
    inputs: Mapping[str, Tensor] = field(default_factory=dict)
    """Label to rgb image: LiDAR image, warped reference, confidence."""


@dataclass(frozen=True, kw_only=True)
class MovingPicture:
    """An animated picture that stands inside a page."""

    data_url: str
    caption: str


@dataclass(frozen=True, kw_only=True, eq=False)
class WorstView:
    """A held-out view that a scene shows badly, beside what was recorded."""

    title: str
    rendered_rgb: Float[Tensor, "height width 3"]
    truth_rgb: Float[Tensor, "height width 3"]


def comparisons(
    held_out: HeldOut,
    unpainted: GaussianScene,
    painting: ViewTimePainting,
    shifts: Sequence[Shift],
    *,
    progress: Callable[[int, int], None],
) -> list[Comparison]:
    """The middle judged view, as recorded and at every shift; tells how many of them are done.

    `painting` is the painter's work on views of the final scene.
    """
    builder = painting.conditions
    view = held_out.test_views[len(held_out.test_views) // 2]
    compared = []
    for shift in (Shift(), *shifts):
        before = unpainted.render(
            held_out.shifted_camera(unpainted, view, shift),
            view.timestamp_ns,
            camera_name=view.camera_name,
        )
        camera = held_out.shifted_camera(builder.scene, view, shift)
        conditions = builder.conditions(camera, view.timestamp_ns, camera_name=view.camera_name)
        painted = painting.painter.load(painting.device).paint(conditions)
        inputs = {
            "LiDAR": conditions.lidar_rgb,
            "warped recording": conditions.warp_rgb[0],
            "painted at view time": painted.rgb,
            "confidence": painted.confidence[..., None].expand(-1, -1, 3),
        }
        truth_rgb, street = None, known_street(held_out.scene)
        if street is not None:
            truth_rgb = street.render(camera, view.timestamp_ns).rgb
        elif shift == Shift():  # nobody took an image elsewhere
            truth_rgb = held_out.image_of(view)
        compared.append(
            Comparison(
                title=f"{shift.name}, {view.camera_name}, frame {view.frame_index}",
                before_rgb=before.rgb.clamp(0, 1).cpu(),
                after_rgb=conditions.render_rgb.clamp(0, 1).cpu(),
                truth_rgb=truth_rgb,
                inputs={name: rgb.cpu() for name, rgb in inputs.items()},
            )
        )
        progress(len(compared), 1 + len(shifts))
    return compared


def recorded_beside(held_out: HeldOut, fitted: GaussianScene, shift: Shift) -> MovingPicture:
    """The first judged camera's drive: left as recorded, right from a step aside."""
    views = held_out.scene.views_of(held_out.test_views[0].camera_name)
    first = max((len(views) - MOST_MOMENTS) // 2, 0)
    views = views[first : first + MOST_MOMENTS]
    animation, frames = cv2.Animation(), []
    for view in views:
        camera = held_out.shifted_camera(fitted, view, shift)
        aside = fitted.render(camera, view.timestamp_ns, camera_name=view.camera_name)
        frames.append(np.hstack([_panel(held_out.image_of(view)), _panel(aside.rgb)]))
    animation.frames = frames
    animation.durations = _durations_ms([view.timestamp_ns for view in views])
    settings = [cv2.IMWRITE_WEBP_QUALITY, MOVING_QUALITY]
    _, encoded = cv2.imencodeanimation(".webp", animation, settings)
    data = base64.b64encode(encoded.tobytes()).decode("ascii")
    return MovingPicture(
        data_url=f"data:image/webp;base64,{data}",
        caption=f"Left: recorded by {views[0].camera_name}. Right: the scene, {shift.name}.",
    )


def _panel(rgb: Float[Tensor, "height width 3"]) -> np.ndarray:
    bgr = cv2.cvtColor(to_bytes(rgb), cv2.COLOR_RGB2BGR)
    height_px = max(round(bgr.shape[0] * PANEL_WIDTH_PX / bgr.shape[1]), 1)
    return cv2.resize(bgr, (PANEL_WIDTH_PX, height_px), interpolation=cv2.INTER_AREA)


def _durations_ms(times_ns: list[int]) -> list[int]:
    """How long every frame stands; the last one as long as the one before."""
    steps_ns = [after - before for before, after in pairwise(times_ns)]
    steps = [max(step_ns // 1_000_000, SHORTEST_MS) for step_ns in steps_ns]
    return [*steps, steps[-1] if steps else 100]


def worst_views(held_out: HeldOut, fitted: GaussianScene) -> list[WorstView]:
    """Those of the least PSNR at interpolated poses, worst first."""
    found: list[tuple[float, WorstView]] = []
    for view in held_out.sampled(MOST_LOOKED_AT).test_views:
        camera = held_out.camera_of(fitted, view, "interpolated")
        rendered = fitted.render(camera, view.timestamp_ns, camera_name=view.camera_name)
        rgb, truth = rendered.rgb.clamp(0, 1).cpu(), held_out.image_of(view)
        hidden = fitted.cameras.own_bodies.get(view.camera_name)
        judged = rgb if hidden is None else torch.where(hidden[..., None], truth, rgb)
        psnr = score_image(judged, truth, hidden=hidden).psnr_db
        title = f"frame {view.frame_index}, {view.camera_name}: {psnr:.1f} dB"
        found.append((psnr, WorstView(title=title, rendered_rgb=rgb, truth_rgb=truth)))
        found = sorted(found, key=lambda pair: pair[0])[:NUM_WORST]
    return [view for _, view in found]


def write_beside(view: WorstView, path: Path) -> Path:
    """Write one as a small JPEG, rendered on the left and recorded on the right.

    Raises:
        WriteError: the file cannot be written.
    """
    both = [small_image(rgb, THUMBNAIL_WIDTH_PX) for rgb in (view.rendered_rgb, view.truth_rgb)]
    return write_jpeg(torch.cat(both, dim=1), path)


def read_beside(path: Path, title: str) -> WorstView:
    """Read what `write_beside` wrote.

    Raises:
        DataError: that is no such image.
    """
    rendered, truth = read_image(path).chunk(2, dim=1)
    return WorstView(title=title, rendered_rgb=rendered, truth_rgb=truth)
