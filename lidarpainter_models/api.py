"""The library for notebooks and scripts: `import lidarpainter_models as lp`.

Open a scene, split its views, prepare what a fit may see, fit Gaussians to it; render what came
out at any camera and time, paint it, judge it. Nothing is stored: runs that are kept, resumed and
never computed twice are the `lidarpainter` command's.
"""

from collections.abc import Sequence
from pathlib import Path

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.scene_evaluation import SceneEvaluation
from lidarpainter_models.evaluation.score_tables import Scores
from lidarpainter_models.evaluation.settings import SCORED_SHIFTS, EvaluationConfig, ScoringConfig
from lidarpainter_models.evaluation.shown import ShownScene
from lidarpainter_models.export.images import write_png
from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.geometry.trajectories import road_directions, shift_pose
from lidarpainter_models.observations.preparation import prepare_observations
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.observations.views import TrainingView
from lidarpainter_models.painter.selection import load_painter
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.splits import ViewSplit, split_views
from lidarpainter_models.synthetic import SyntheticStreetConfig, write_street

__all__ = [
    "ConditionBuilder",
    "FitConfig",
    "ObservationConfig",
    "Shift",
    "SyntheticStreetConfig",
    "camera_beside",
    "evaluate",
    "fit_gaussians",
    "load_painter",
    "open_scene",
    "prepare_observations",
    "split_views",
    "write_png",
    "write_street",
]


def open_scene(folder: Path) -> DrivingScene:
    """The stored scene in a folder such as `STORE/scenes/pandaset/002`; images are read when asked.

    Raises:
        SceneError: there is no scene, or it is incomplete or damaged.
    """
    return DrivingScene.open(folder)


def camera_beside(
    fitted: GaussianScene, scene: DrivingScene, view: TrainingView, shift: Shift
) -> Camera:
    """The camera of a training view as the fit found it, moved aside, up or turned."""
    camera = fitted.refined_camera(view)
    direction = road_directions(scene.world_from_ego)[scene.frame_position(view.key[0])]
    return camera.at(shift_pose(camera.world_from_camera, direction, shift))


def evaluate(
    fitted: GaussianScene,
    scene: DrivingScene,
    split: ViewSplit,
    observation: ObservationConfig,
    *,
    shifts: Sequence[Shift] = SCORED_SHIFTS,
) -> Scores:
    """`recorded` and `novel` scores as `reconstruct --json` prints them.

    Args:
        fitted: the scene to judge, as it is.
        scene: where its held-out images and sweeps are read from.
        split: the one that it was fitted with.
        observation: as it was prepared for the fit.
        shifts: where beside the path it is judged too: by LiDAR, and where the scene is a
            synthetic street, by exact images.
    """
    config = EvaluationConfig(
        observation=observation,
        scoring=ScoringConfig(shifts=tuple(shifts)),
        conditions=ConditionConfig(),
    )
    held_out = HeldOut(scene=scene, test_views=split.test, observation=observation)
    evaluation = SceneEvaluation(held_out=held_out, config=config)
    return evaluation.scores(ShownScene(scene=fitted), progress=lambda _done, _total: None)
