"""The protocol of neurad-studio on held-out images: its poses, its crop, every view.

So the results on PandaSet of NeuRAD (Tonderski et al., 2024) and its followers are made: every
held-out image of the split `linspace`, rendered from its recorded pose, compared as a whole (the
back camera of PandaSet without the rows that show the recording car); PSNR, SSIM and LPIPS are
means over images. What makes a figure unlike a published one stands beside it: how large the images
were, how many there were, and why a distance is absent.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import count
from typing import Any

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.scene_evaluation import NO_INCEPTION
from lidarpainter_models.evaluation.score_tables import NEURAD, Scores
from lidarpainter_models.evaluation.shown import ShownScene
from lidarpainter_models.evaluation.view_scores import ScoredView, score_views
from lidarpainter_models.metrics.perceptual import PerceptualDistances

SPLIT = "linspace"
"""Half of the frames at even steps; the rest is judged."""
FIGURES = ("psnr", "ssim", "lpips", "lpips_reason", "num_views")
CUT_ROWS = {("pandaset", "back_camera"): 260 / 1080}
"""Part of the rows at the bottom of a camera's images that is cut off, by data set and camera."""


def neurad_scores(
    held_out: HeldOut,
    shown: ShownScene,
    distances: PerceptualDistances,
    progress: Callable[[int, int], None],
) -> Scores:
    """Score every held-out image at its recorded pose.

    Returns:
        Under `neurad`: by camera, and under `all` over every image, `psnr` (dB), `ssim`, `lpips`
        and its `lpips_reason` where it is absent, `fid` and `kid` (always absent, with their
        reasons), `num_views`, and the `num_columns` of the images.
    """
    views = held_out.recorded_views(shown.scene, "recorded")
    renders = count(1)
    found: dict[str, dict[str, Any]] = {}
    cameras = [view.camera_name for view in held_out.test_views]
    for name in dict.fromkeys(cameras):
        cut = CUT_ROWS.get((held_out.scene.dataset, name), 0.0)
        own = [
            cropped(view, cut)
            for view, camera in zip(views, cameras, strict=True)
            if camera == name
        ]
        scores = score_views(
            shown.renderer(name),
            own,
            distances=distances,
            device=shown.scene.device,
            told=lambda: progress(next(renders), len(views)),
        )
        found[name] = {each: getattr(scores, each) for each in FIGURES}
        found[name]["num_columns"] = own[0].camera.width_px
    return {NEURAD: {**found, "all": _over_all(list(found.values()))}}


def cropped(view: ScoredView, cut_share: float) -> ScoredView:
    """The view without such a part of its rows at the bottom; all that is left is judged."""
    rows = round(view.camera.height_px * (1 - cut_share))
    return replace(
        view, truth_rgb=view.truth_rgb[:rows], actor_index=view.actor_index[:rows], hidden=None
    )


def _over_all(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """The mean over every image of all cameras, and why two distances are absent."""
    weigh = partial(_weighed, parts)
    return {
        "psnr": weigh("psnr"),
        "ssim": weigh("ssim"),
        "lpips": weigh("lpips"),
        "lpips_reason": parts[0]["lpips_reason"],
        "num_views": sum(part["num_views"] for part in parts),
        "num_columns": parts[0]["num_columns"],
        "fid": None,
        "fid_reason": NO_INCEPTION,
        "kid": None,
        "kid_reason": NO_INCEPTION,
    }


def _weighed(parts: list[dict[str, Any]], name: str) -> float | None:
    if any(part[name] is None for part in parts):
        return None
    total = sum(part[name] * part["num_views"] for part in parts)
    return float(total / sum(part["num_views"] for part in parts))
