"""The held-out views that a scene shows worst, so that nobody has to look for them."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.export.images import read_image, small_image, write_jpeg
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.metrics.images import score_image

MOST_LOOKED_AT = 24
"""Views that are rendered for it, spread over all."""
NUM_SHOWN = 3
THUMBNAIL_WIDTH_PX = 400
"""Of each half, where many runs are shown on one page."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WorstView:
    """One of them beside what was recorded."""

    title: str
    rendered_rgb: Float[Tensor, "height width 3"]
    truth_rgb: Float[Tensor, "height width 3"]


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
        found = sorted(found, key=lambda pair: pair[0])[:NUM_SHOWN]
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
