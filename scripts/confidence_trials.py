"""Frames of synthetic streets from anywhere, what speaks for them, and how good they truly are.

Frames are drawn at random: a moment of the log and a step off the path, along one direction of the
envelope or several at once. World: x forward, y left, z up; metres.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Generator

from lidarpainter_models.conditioning.view_evidence import ViewEvidence
from lidarpainter_models.errors import SceneError
from lidarpainter_models.evaluation.envelope import MovedViews
from lidarpainter_models.evaluation.scene_evaluation import known_street
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.trajectory_words import ConstantStep
from lidarpainter_models.metrics.images import psnr_from_error, squared_error
from lidarpainter_models.scenes.records import RecordedView

FARTHEST = {"aside": 6.0, "up": 5.0, "ahead": 8.0, "yaw": 60.0}
"""Metres and degrees, to both sides. Of a uniform number the square is drawn: half of all steps are
within a quarter of the way."""
RECORDED_SHARE = 0.1
"""Of frames that are drawn on the path itself."""
MIXED_SHARE = 0.2
"""Of frames that are drawn with several steps at once, each half as large."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One frame with known truth."""

    frame_index: int
    step: ConstantStep
    evidence: ViewEvidence
    psnr_db: float
    """Of the scene as it is, at the size of the fit."""


def drawn_step(generator: Generator) -> ConstantStep:
    """A random step off the path."""
    kind, *amounts = torch.rand(6, generator=generator).tolist()
    if kind < RECORDED_SHARE:
        return ConstantStep()
    sizes = [amount**2 for amount in amounts]
    steps = {
        "lateral_m": FARTHEST["aside"] * sizes[0],
        "up_m": FARTHEST["up"] * sizes[1],
        "along_m": FARTHEST["ahead"] * sizes[2],
        "yaw_rad": math.radians(FARTHEST["yaw"]) * sizes[3],
    }
    for two_sided in ("lateral_m", "yaw_rad"):
        steps[two_sided] *= 1 if torch.rand(1, generator=generator) < 0.5 else -1
    if kind < RECORDED_SHARE + MIXED_SHARE:
        return ConstantStep(**{name: value / 2 for name, value in steps.items()})
    # to the sides and turns are two directions of the envelope each
    names = ("lateral_m", "lateral_m", "up_m", "along_m", "yaw_rad", "yaw_rad")
    name = names[min(int(amounts[4] * len(names)), len(names) - 1)]
    return ConstantStep(**{name: steps[name]})


def true_psnr_db(views: MovedViews, camera: Camera, view: RecordedView) -> float:
    """PSNR of what the scene shows against the street itself.

    Raises:
        SceneError: the scene is no synthetic street.
    """
    street = known_street(views.scene)
    if street is None:
        raise SceneError(f"{views.scene.path}: nobody knows its true images beside the path")
    fitted = views.gatherer.scene
    shown = fitted.render(camera, view.timestamp_ns, camera_name=view.camera_name).rgb
    truth = street.render(camera, view.timestamp_ns).rgb.clamp(0, 1)
    return psnr_from_error(float(squared_error(shown, truth.to(shown)).mean()))


def trials(views: MovedViews, camera_name: str, count: int, *, seed: int) -> Iterator[Trial]:
    """So many frames of a camera at random; places where nobody can stand are drawn again."""
    generator = Generator().manual_seed(seed)
    recorded = views.scene.views_of(camera_name)
    found = 0
    while found < count:
        view = recorded[int(torch.randint(len(recorded), (1,), generator=generator))]
        step = drawn_step(generator)
        camera = views.camera(view, step)
        if camera is None:
            continue
        found += 1
        yield Trial(
            frame_index=view.frame_index,
            step=step,
            evidence=views.gatherer.of(camera, view.timestamp_ns, camera_name),
            psnr_db=true_psnr_db(views, camera, view),
        )
