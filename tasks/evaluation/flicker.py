"""Judge how steady a scene looks along shifted paths, as rendered and as painted at view time."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from prefect import task
from torch import Tensor

from catalog.artefacts import Workplace
from catalog.store import open_store
from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.sequences import SequenceConfig, SequencePainter
from lidarpainter_models.evaluation.flicker import TRUTH, FlickerFrame, FlickerTally
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.geometry.trajectories import Shift
from lidarpainter_models.painter import load_painter
from lidarpainter_models.painter.protocol import Painter
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.synthetic.street import SyntheticStreet
from tasks.evaluation.judging import known_street
from tasks.evaluation.scene import JudgeSettings
from tasks.evaluation.scores import FLICKER, SCORES_FILE
from tasks.json_files import write_json
from tasks.painter.painters import painter_digest
from tasks.progress import listener
from tasks.scenes import SplitSpec, open_split
from tasks.stages import STAGE_OPTIONS, StageResult, run_stage
from tasks.stored import FittedRef, load_observations, load_scene

RENDER = "render"
PAINTED = "painted"


@dataclass(frozen=True, kw_only=True, eq=False)
class _Path:
    """One camera moved along its path."""

    held_out: HeldOut
    builder: ConditionBuilder
    street: SyntheticStreet | None
    """The world itself, where it is known."""
    views: Sequence[RecordedView]
    camera_name: str
    painter: Painter
    previous: Sequence[SequenceConfig]

    def scores(self, shift: Shift) -> dict[str, Any]:
        """The figures of all images at a shift, by image."""
        painters = {
            _label(config): SequencePainter(
                self.builder, self.painter, config=config, camera_name=self.camera_name
            )
            for config in (SequenceConfig(), *self.previous)
        }
        tally = FlickerTally(self.builder.tracks, self.builder.config.warp)
        for view in self.views:
            tally.add(self._frame(view, shift, painters))
        return {name: asdict(found) for name, found in tally.scores().items()}

    def _frame(
        self, view: RecordedView, shift: Shift, painters: dict[str, SequencePainter]
    ) -> FlickerFrame:
        camera = self.held_out.shifted_camera(self.builder.scene, view, shift)
        time_ns = view.timestamp_ns
        conditions = self.builder.conditions(camera, time_ns, camera_name=self.camera_name)
        images: dict[str, Float[Tensor, "height width 3"]] = {RENDER: conditions.render_rgb}
        for name, painter in painters.items():
            images[name] = painter.paint_conditions(conditions, camera, time_ns).rgb
        if self.street is not None:
            images[TRUTH] = self.street.render(camera, time_ns).rgb.clamp(0, 1)
        return FlickerFrame(
            camera=camera,
            timestamp_ns=time_ns,
            depth_m=conditions.render_depth_m,
            alpha=conditions.render_alpha,
            images=images,
        )


@task(**STAGE_OPTIONS)
def evaluate_flicker(
    store_path: Path,
    stage: str,
    split: SplitSpec,
    fitted: FittedRef,
    settings: JudgeSettings,
    painter: str,
    previous: tuple[SequenceConfig, ...],
) -> StageResult:
    """Compare neighbouring frames of the first trained camera at every judged shift.

    Args:
        store_path: the store.
        stage: its name for the listener.
        split: whose cameras were trained on; all frames are looked at.
        fitted: what is rendered.
        settings: the shifts, and how conditions are gathered.
        painter: who paints at view time.
        previous: what else may become of the frame painted before.
    """
    store = open_store(store_path)
    recorded, views = open_split(store, split)

    def build(place: Workplace) -> dict[str, Any]:
        seen = load_observations(store, fitted.observations)
        scene = load_scene(store, fitted.gaussians)
        camera_name = views.train[0].camera_name
        path = _Path(
            held_out=HeldOut(scene=recorded, test_views=(), observation=settings.observation),
            builder=ConditionBuilder(scene, seen.lidar_map, seen.views, config=settings.conditions),
            street=known_street(recorded),
            views=recorded.views_of(camera_name),
            camera_name=camera_name,
            painter=load_painter(painter),
            previous=previous,
        )
        shifts = settings.scoring.shifts
        scores = {}
        for done, shift in enumerate(shifts, start=1):
            scores[shift.name] = path.scores(shift)
            listener().advanced(stage, done, len(shifts), "")
        write_json(place.output / SCORES_FILE, {FLICKER: scores})
        return {"num_shifts": len(shifts)}

    return run_stage(
        store,
        stage=stage,
        kind="evaluation",
        inputs={
            "scene": recorded.content_digest,
            "observations": fitted.observations.digest,
            "gaussians": fitted.gaussians.digest,
            "painter": painter_digest(painter),
        },
        config={
            "split": split,
            "observation": asdict(settings.observation),
            "conditions": asdict(settings.conditions),
            "shifts": [asdict(shift) for shift in settings.scoring.shifts],
            "previous": [asdict(config) for config in previous],
        },
        build=build,
    )


def by_image(flicker: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The same scores as the catalog takes them: by image, then by shift."""
    images = {name for found in flicker.values() for name in found}
    return {
        image: {FLICKER: {shift: found[image] for shift, found in flicker.items()}}
        for image in sorted(images)
    }


def _label(config: SequenceConfig) -> str:
    return PAINTED if config.previous == "unused" else f"{PAINTED}, previous {config.previous}"
