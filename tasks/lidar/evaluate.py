"""Judge simulated sweeps of a run by those that no fit has read."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from catalog.artefacts import ArtefactRef, Workplace
from lidarpainter_models.evaluation.lidar_scores import LidarEvaluation
from lidarpainter_models.evaluation.score_tables import LIDAR
from lidarpainter_models.gaussians.lidar_returns.channel import LidarChannel
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from tasks.evaluation.views import SCORES_FILE
from tasks.json_files import write_json
from tasks.lidar.channel import corrected_scene, lidar_of, load_channel, mounted
from tasks.opened import OpenedRun, opened
from tasks.progress import Progress
from tasks.specs import FittedRef, RunSpec
from tasks.stages import StageResult, run_stage, stage_task
from tasks.stored import load_scene

STAGE = "evaluate-lidar"


@stage_task
def evaluate_lidar(run: RunSpec, fitted: FittedRef, channel: ArtefactRef) -> StageResult:
    """Score the sweeps of held-out frames, those of the log's first LiDAR.

    Raises:
        ConfigError: no sweep was held out.
    """
    this = opened(run)
    name = lidar_of(this.scene, None)
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage=STAGE,
        kind="evaluation",
        inputs={
            "scene": this.scene.content_digest,
            "gaussians": fitted.gaussians.digest,
            "lidar": channel.digest,
        },
        config={"split": run.split, "lidar": name},
        build=partial(_build, judged=partial(_judged, this, fitted, channel, name)),
    )


_Judged = tuple[LidarEvaluation, LidarChannel, GaussianScene]


def _judged(this: OpenedRun, fitted: FittedRef, channel: ArtefactRef, name: str) -> _Judged:
    # what was recorded is of clear air, whatever style the run is in
    scene = replace(load_scene(this.store, fitted.gaussians), style=None)
    evaluation = LidarEvaluation(
        scene=corrected_scene(this, scene),
        lidar=mounted(this, scene, name),
        test_frames=this.views.test_frames,
    )
    return evaluation, load_channel(this.store, channel), scene


def _build(
    place: Workplace, progress: Progress, *, judged: Callable[[], _Judged]
) -> dict[str, Any]:
    evaluation, channel, scene = judged()
    scores = evaluation.scores(channel, scene, progress)
    write_json(place.output / SCORES_FILE, {LIDAR: scores})
    return {"num_sweeps": scores["num_sweeps"]}
