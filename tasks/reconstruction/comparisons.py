"""Images for the report: one moment seen from every trajectory, before and after painting."""

from dataclasses import dataclass

import torch

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.export.report import Comparison
from lidarpainter_models.gaussians.model.scene_graph import GaussianScene
from lidarpainter_models.geometry.trajectories import Shift
from lidarpainter_models.painter.protocol import Painter
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.synthetic.street import SyntheticStreet


@dataclass(frozen=True, kw_only=True)
class Subject:
    """What is compared."""

    held_out: HeldOut
    unpainted: GaussianScene
    final: GaussianScene
    final_builder: ConditionBuilder
    painter: Painter
    street: SyntheticStreet | None
    """The exact world, where the scene is a synthetic street."""


def comparisons(subject: Subject, shifts: tuple[Shift, ...]) -> list[Comparison]:
    """The middle judged view, as recorded and at every shift."""
    view = subject.held_out.test_views[len(subject.held_out.test_views) // 2]
    return [_comparison(subject, view, shift) for shift in (Shift(), *shifts)]


def _comparison(subject: Subject, view: RecordedView, shift: Shift) -> Comparison:
    before = subject.unpainted.render(
        subject.held_out.shifted_camera(subject.unpainted, view, shift),
        view.timestamp_ns,
        camera_name=view.camera_name,
    )
    camera = subject.held_out.shifted_camera(subject.final, view, shift)
    after = subject.final.render(camera, view.timestamp_ns, camera_name=view.camera_name)
    conditions = subject.final_builder.conditions(
        camera, view.timestamp_ns, camera_name=view.camera_name
    )
    painting = subject.painter.paint(conditions)
    inputs = {
        "LiDAR": conditions.lidar_rgb,
        "warped recording": conditions.warp_rgb[0],
        "painted at view time": painting.rgb,
        "confidence": painting.confidence[..., None].expand(-1, -1, 3),
    }
    truth = _truth(subject, view, shift)
    if truth is not None:
        inputs = {"truth": truth, **inputs}
    return Comparison(
        title=f"{shift.name}, {view.camera_name}, frame {view.frame_index}",
        before_label="before painting",
        before_rgb=before.rgb.clamp(0, 1),
        after_label="after painting",
        after_rgb=after.rgb.clamp(0, 1),
        inputs=inputs,
    )


def _truth(subject: Subject, view: RecordedView, shift: Shift) -> torch.Tensor | None:
    camera = subject.held_out.shifted_camera(subject.final, view, shift)
    if subject.street is not None:
        return subject.street.render(camera, view.timestamp_ns).rgb
    if shift != Shift():
        return None  # nobody took this image
    single = HeldOut(
        scene=subject.held_out.scene,
        test_views=[view],
        observation=subject.held_out.observation,
    )
    return single.recorded_views(subject.final, "interpolated")[0].truth_rgb
