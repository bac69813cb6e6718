"""Shifted paths of one camera, rendered and painted frame by frame, and how much they flicker."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.conditioning.sequences import SequencePainter
from lidarpainter_models.conditioning.settings import SequenceConfig
from lidarpainter_models.evaluation.flicker import TRUTH, FlickerFrame, FlickerTally
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.scene_evaluation import known_street
from lidarpainter_models.evaluation.shown import ViewTimePainting
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.scenes.records import RecordedView

RENDER = "render"
PAINTED = "painted"


@dataclass(frozen=True, kw_only=True, eq=False)
class FlickerEvaluation:
    """How neighbouring frames of a fitted scene are compared, as rendered and as painted."""

    held_out: HeldOut
    camera_name: str
    """Whose path is shifted."""
    shifts: Sequence[Shift]
    previous: Sequence[SequenceConfig]
    """What else may become of the frame painted before."""

    def scores(
        self, painting: ViewTimePainting, progress: Callable[[int, int], None]
    ) -> dict[str, dict[str, Any]]:
        """The figures of every shift, by image."""
        found = {}
        for done, shift in enumerate(self.shifts, start=1):
            found[shift.name] = self._of_path(shift, painting)
            progress(done, len(self.shifts))
        return found

    def _of_path(self, shift: Shift, painting: ViewTimePainting) -> dict[str, Any]:
        builder, painter = painting.conditions, painting.painter.load(painting.device)
        painters = {
            _label(config): SequencePainter(
                builder, painter, config=config, camera_name=self.camera_name
            )
            for config in (SequenceConfig(), *self.previous)
        }
        tally = FlickerTally(builder.boxes.tracks)
        for view in self.held_out.scene.views_of(self.camera_name):
            tally.add(self._frame(view, shift, painting, painters))
        return {name: asdict(found) for name, found in tally.scores().items()}

    def _frame(
        self,
        view: RecordedView,
        shift: Shift,
        painting: ViewTimePainting,
        painters: dict[str, SequencePainter],
    ) -> FlickerFrame:
        builder, time_ns = painting.conditions, view.timestamp_ns
        camera = self.held_out.shifted_camera(builder.scene, view, shift)
        conditions = builder.conditions(camera, time_ns, camera_name=self.camera_name)
        images: dict[str, Float[Tensor, "height width 3"]] = {RENDER: conditions.render_rgb}
        for name, painter in painters.items():
            images[name] = painter.paint_conditions(conditions, camera, time_ns).rgb
        street = known_street(self.held_out.scene)
        if street is not None:
            truth = street.render(camera, time_ns).rgb.clamp(0, 1)
            images[TRUTH] = truth.to(conditions.render_rgb.device)
        return FlickerFrame(
            camera=camera,
            timestamp_ns=time_ns,
            depth_m=conditions.render_depth_m,
            alpha=conditions.render_alpha,
            images=images,
        )


def _label(config: SequenceConfig) -> str:
    return PAINTED if config.previous == "unused" else f"{PAINTED}, previous {config.previous}"
