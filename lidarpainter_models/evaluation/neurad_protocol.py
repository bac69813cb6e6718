"""The protocol of neurad-studio on held-out images: its poses, its crop, every view.

So the results on PandaSet of NeuRAD (Tonderski et al., 2024) and its followers are made: every
held-out image of the split `linspace`, rendered from its recorded pose, compared as a whole (the
back camera of PandaSet without the rows that show the recording car); PSNR, SSIM and LPIPS are
means over images. FID compares the held-out images with renders at the same poses and with renders
2 and 3 m aside and 1 m up (neurad-studio takes one side of each sequence; here stand both). What
makes a figure unlike a published one stands beside it: how large the images were, how many there
were, and why a distance is absent.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from typing import Any

from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.evaluation.fid_scores import fid_scores, shown_images
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.score_tables import NEURAD, Scores
from lidarpainter_models.evaluation.shown import ShownScene
from lidarpainter_models.evaluation.view_scores import ScoredView, score_views
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.metrics.perceptual import PerceptualDistances
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView

SPLIT = "linspace"
"""Half of the frames at even steps; the rest is judged."""
SHIFTS = (
    Shift(),
    Shift(lateral_m=2.0),
    Shift(lateral_m=-2.0),
    Shift(lateral_m=3.0),
    Shift(lateral_m=-3.0),
    Shift(up_m=1.0),
)
"""Where FID is computed."""
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
        and its `lpips_reason` where it is absent, `num_views`, and the `num_columns` of the images.
        Under `all` also `fid` and `kid` at the recorded poses, and the same under the name of each
        shift; absent with a reason.
    """
    views = held_out.recorded_views(shown.scene, "recorded")
    renders, num_renders = count(1), len(views)
    num_renders *= 1 if distances.inception is None else 1 + len(SHIFTS)

    def told() -> None:
        progress(next(renders), num_renders)

    found: dict[str, dict[str, Any]] = {}
    cameras = [view.camera_name for view in held_out.test_views]
    for name in dict.fromkeys(cameras):
        own = [
            cropped(view, num_kept_rows(held_out.scene, name, view.camera.height_px))
            for view, camera in zip(views, cameras, strict=True)
            if camera == name
        ]
        scores = score_views(
            shown.renderer(name), own, distances=distances, device=shown.scene.device, told=told
        )
        found[name] = {each: getattr(scores, each) for each in FIGURES}
        found[name]["num_columns"] = own[0].camera.width_px
    likeness = _likeness(held_out, shown, distances, told)
    found["all"] = {**_over_all(list(found.values())), **likeness.pop(Shift().name)}
    return {NEURAD: {**found, **likeness}}


def _likeness(
    held_out: HeldOut, shown: ShownScene, distances: PerceptualDistances, told: Callable[[], None]
) -> dict[str, dict[str, Any]]:
    """FID and KID at each shift, against the held-out images, all without the rows cut off."""
    scene = held_out.scene
    views = [] if distances.inception is None else held_out.test_views

    def kept(
        image: Float[Tensor, "height width 3"], view: RecordedView
    ) -> Float[Tensor, "_height width 3"]:
        return image[: num_kept_rows(scene, view.camera_name, len(image))]

    def shifted(shift: Shift) -> Iterator[Float[Tensor, "_height _width 3"]]:
        placed = [
            (view, held_out.shifted_camera(shown.scene, view, shift, "recorded")) for view in views
        ]
        return map(kept, shown_images(shown, placed, told), views)

    real = map(kept, map(held_out.image_of, views), views)
    return fid_scores(distances.inception, real, {shift.name: shifted(shift) for shift in SHIFTS})


def num_kept_rows(scene: DrivingScene, camera_name: str, num_rows: int) -> int:
    """How many rows of a camera's images are judged, from the top."""
    cut_share = CUT_ROWS.get((scene.dataset, camera_name), 0.0)
    return round(num_rows * (1 - cut_share))


def cropped(view: ScoredView, rows: int) -> ScoredView:
    """The view with so many of its rows, from the top; all that is left is judged."""
    return replace(
        view, truth_rgb=view.truth_rgb[:rows], actor_index=view.actor_index[:rows], hidden=None
    )


def _over_all(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """The mean over every image of all cameras."""
    num_views = sum(part["num_views"] for part in parts)

    def mean(name: str) -> float | None:
        if any(part[name] is None for part in parts):
            return None
        return float(sum(part[name] * part["num_views"] for part in parts) / num_views)

    return {
        **{name: mean(name) for name in ("psnr", "ssim", "lpips")},
        "lpips_reason": parts[0]["lpips_reason"],
        "num_views": num_views,
        "num_columns": parts[0]["num_columns"],
    }
