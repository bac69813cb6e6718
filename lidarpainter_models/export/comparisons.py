"""Images for the report: one moment seen from every trajectory, before and after painting."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.scene_evaluation import known_street
from lidarpainter_models.evaluation.shown import ViewTimePainting
from lidarpainter_models.export.report import Comparison
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.scenes.records import RecordedView


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """What is compared."""

    held_out: HeldOut
    unpainted: GaussianScene
    painting: ViewTimePainting
    """The painter's work on views of the final scene."""


def comparisons(
    subject: Subject, shifts: Sequence[Shift], *, progress: Callable[[int, int], None]
) -> list[Comparison]:
    """The middle judged view, as recorded and at every shift; tells how many of them are done."""
    view = subject.held_out.test_views[len(subject.held_out.test_views) // 2]
    compared = []
    for shift in (Shift(), *shifts):
        compared.append(_comparison(subject, view, shift))
        progress(len(compared), 1 + len(shifts))
    return compared


def _comparison(subject: Subject, view: RecordedView, shift: Shift) -> Comparison:
    builder, held_out = subject.painting.conditions, subject.held_out
    before = subject.unpainted.render(
        held_out.shifted_camera(subject.unpainted, view, shift),
        view.timestamp_ns,
        camera_name=view.camera_name,
    )
    camera = held_out.shifted_camera(builder.scene, view, shift)
    conditions = builder.conditions(camera, view.timestamp_ns, camera_name=view.camera_name)
    painting = subject.painting.painter.load(subject.painting.device).paint(conditions)
    inputs = {
        "LiDAR": conditions.lidar_rgb,
        "warped recording": conditions.warp_rgb[0],
        "painted at view time": painting.rgb,
        "confidence": painting.confidence[..., None].expand(-1, -1, 3),
    }
    truth_rgb = None
    street = known_street(held_out.scene)
    if street is not None:
        truth_rgb = street.render(camera, view.timestamp_ns).rgb
    elif shift == Shift():  # nobody took an image elsewhere
        truth_rgb = held_out.image_of(view)
    return Comparison(
        title=f"{shift.name}, {view.camera_name}, frame {view.frame_index}",
        before_label="before painting",
        before_rgb=before.rgb.clamp(0, 1).cpu(),
        after_label="after painting",
        after_rgb=conditions.render_rgb.clamp(0, 1).cpu(),
        truth_rgb=truth_rgb,
        inputs={name: rgb.cpu() for name, rgb in inputs.items()},
    )
