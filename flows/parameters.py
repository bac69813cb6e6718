"""What a flow is given: frozen models that hold the library's settings as fields."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from lidarpainter_models.conditioning.settings import ConditionConfig, NovelGuidanceConfig
from lidarpainter_models.devices import KernelChoice, check_device
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.score_tables import fitted_on
from lidarpainter_models.evaluation.settings import EvaluationConfig, ScoringConfig
from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.observations.settings import ObservationConfig
from tasks.runs import FinishedRun
from tasks.specs import RunSpec, SplitSpec


class ViewParameters(BaseModel):
    """What decides how a fitted scene is seen and judged."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: str
    """`<dataset>/<sequence>`."""
    preset: str
    """Name of the preset these parameters started from."""
    split: str = "alternate"
    """Which frames train and which judge: `alternate`, `linspace`, `forward:17:8`, `all`."""
    train_cameras: tuple[str, ...] | None = None
    """Cameras to train on and to judge; None takes all."""
    observation: ObservationConfig
    painter: str
    """Name of a painter, path of its weights or model, or `none`: then the fit is continued
    as long without painted views, which is the control for the painted one."""
    device: str = "auto"
    """Where fits, painters and judges run: `cpu`, `cuda`, `cuda:1`; `auto` takes a GPU if any."""
    kernels: KernelChoice = "auto"
    """Which kernels do the work: `auto` our own, `gsplat` gsplat's rasteriser on a GPU, `torch`
    plain torch for all but the rasteriser, as a GPU does, to be tried on a CPU."""
    conditions: ConditionConfig
    scoring: ScoringConfig
    feature_weights: Path | None = None
    """SqueezeNet 1.1 weights for the feature distance; None leaves it out."""
    lpips: LpipsFiles = LpipsFiles()
    """Weights for LPIPS; without both files it is null, with the reason."""
    inception: Path | None = None
    """Inception's weights for FID and KID; without them both are null, with the reason."""

    @property
    def evaluation_config(self) -> EvaluationConfig:
        """How scenes are judged."""
        return EvaluationConfig(
            observation=self.observation,
            scoring=self.scoring,
            conditions=self.conditions,
            feature_weights=self.feature_weights,
            lpips=self.lpips,
            inception=self.inception,
        )

    @property
    def split_spec(self) -> SplitSpec:
        """Which views may be seen."""
        return SplitSpec(scene_id=self.scene, spec=self.split, cameras=self.train_cameras)

    def run_spec(self, store_path: Path, *, painter: str | None = None) -> RunSpec:
        """Return what a run works on; another painter may stand in at view time."""
        return RunSpec(
            store_path=store_path,
            split=self.split_spec,
            painter=painter or self.painter,
            device=self.device,
            kernels=self.kernels,
        )

    _known_device = field_validator("device")(check_device)


class ReconstructParameters(ViewParameters):
    """One scene, and everything that decides what becomes of it."""

    fit: FitConfig
    """The fit to what was recorded."""
    novel: NovelGuidanceConfig
    rounds: int = Field(ge=0)
    """How many rounds there are: views are painted, and the fit is continued with them."""
    refine: FitConfig
    """The continued fit of one round."""
    judge: bool = True
    """Judge the scene; one that is not judged has no scores, and `evaluate` can judge it later."""
    examine: bool = False
    """Look for what is wrong about the recording, even if no page is to say it."""
    report: bool = True
    """Write the page about the run."""
    judge_lidar: bool = False
    """Also judge simulated sweeps of the first LiDAR by those held out, which is learnt for it."""
    judge_markings: bool = False
    """Also judge the painted lines that the final scene shows, on its path and beside it."""
    judge_view_time: bool = False
    """Also judge what the final scene shows when it is painted at view time."""

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the stages that a run goes through, in order."""
        paints = fitted_on(self.painter) == "painted"
        rounds = [
            name
            for number in range(1, self.rounds + 1)
            for name in (*([f"paint-{number}"] if paints else []), f"refine-{number}")
        ]
        judged = ["evaluate-unpainted", "evaluate"]
        judged += ["evaluate-view-time"] if self.judge_view_time and paints else []
        more = ["lidar", "evaluate-lidar"] if self.judge_lidar else []
        more += ["evaluate-markings"] if self.judge_markings else []
        first = ["examine"] if self.examines else []
        last = ["report"] if self.report else []
        after = [*first, *([*judged, "envelope", *more] if self.judge else []), *last]
        return ("prepare", "fit", *rounds, *after)

    @property
    def examines(self) -> bool:
        """Whether a run looks for what is wrong about its recording."""
        return self.examine or self.report


def view_parameters(run: FinishedRun) -> ViewParameters:
    """How a finished run was seen and judged; how it was fitted may be of another version.

    Raises:
        ConfigError: this version knows other settings.
    """
    fields = ViewParameters.model_fields.keys() & run.parameters.keys()
    known = {name: run.parameters[name] for name in fields}
    try:
        return ViewParameters.model_validate(known)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ConfigError(
            f"run {run.run_id} has settings of another version: {place}: {first['msg']}; "
            "reconstruct the scene again"
        ) from None
