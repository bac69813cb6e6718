"""The page about a run: its scores, what it took, the course of its fits."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lidarpainter_models.evaluation.score_tables import SCORE_NOTE, score_columns, score_rows
from lidarpainter_models.export.report import Cell, Comparison, Plot, Report, Table
from lidarpainter_models.scenes.driving_scene import DrivingScene

MEGABYTE = 1e6
GUIDANCE_COLUMNS = ("num_cameras", "num_without_room", "num_refused", "num_views", "mean_weight")

GUIDANCE_NOTE = (
    "Cameras beside the path; of them those that would stand in a car or a wall, and those whose "
    "painting was refused; views that the fit went on with, and how much a pixel of them counts."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class StageCost:
    """What a stage took when it was computed."""

    stage: str
    seconds: float
    cpu_seconds: float
    peak_memory_bytes: int
    artefact: str
    """Digest of what it made."""


@dataclass(frozen=True, kw_only=True)
class RunPage:
    """What is known about a run before anything is drawn."""

    result: Mapping[str, Any]
    """What `reconstruct` prints."""
    costs: Sequence[StageCost]
    provenance: Mapping[str, str]
    settings: Mapping[str, str]
    """Every setting of the run by its dotted name, as `--set` takes it."""

    def report(
        self,
        scene: DrivingScene,
        comparisons: Sequence[Comparison],
        histories: Mapping[str, Sequence[Mapping[str, float]]],
        machine: Mapping[str, str],
    ) -> Report:
        """The page, with images and the course of every fit by stage.

        Args:
            scene: what the run is about.
            comparisons: views of it.
            histories: of every fit, by stage.
            machine: names and values of what the page is made on.
        """
        return Report(
            title=f"LidarPainter: {self.result['scene']}",
            summary=[_scene_in_words(scene), _summary(self.result)],
            comparisons=comparisons,
            tables=_tables(self.result, self.costs),
            plots=_plots(histories),
            facts={
                "Provenance": self.provenance,
                "Machine": machine,
                "Settings": self.settings,
            },
        )


def _scene_in_words(scene: DrivingScene) -> str:
    counts = scene.manifest["counts"]
    seconds = float(scene.frame_timestamps_ns[-1] - scene.frame_timestamps_ns[0]) / 1e9
    num_moving = sum(track.is_moving for track in scene.tracks)
    return (
        f"Sequence {scene.sequence} of the dataset {scene.dataset}: {counts['frames']} frames in "
        f"{seconds:.1f} s; {counts['images']} images of {_named('camera', scene.camera_names)}; "
        f"{counts['points'] / 1e6:.1f} million points of {_named('LiDAR', scene.lidar_names)}; "
        f"{len(scene.tracks)} labelled actors, of which {num_moving} move."
    )


def _named(kind: str, names: Sequence[str]) -> str:
    return f"{len(names)} {kind}{'s' if len(names) != 1 else ''} ({', '.join(names)})"


def _summary(result: Mapping[str, Any]) -> str:
    rounds = "1 round" if result["rounds"] == 1 else f"{result['rounds']} rounds"
    return (
        f"Preset {result['preset']}, painter {result['painter']}, split {result['split']}, "
        f"{result['num_gaussians']} Gaussians. Painted means: after {rounds} of "
        "painting shifted views and fitting on with them."
    )


def _tables(result: Mapping[str, Any], costs: Sequence[StageCost]) -> list[Table]:
    """Scores, stages and painted views of a run."""
    stages: list[list[Cell]] = [
        [
            cost.stage,
            cost.seconds,
            cost.cpu_seconds,
            cost.peak_memory_bytes / MEGABYTE,
            cost.artefact,
        ]
        for cost in costs
    ]
    guidance = [
        [name, *(values[key] for key in GUIDANCE_COLUMNS)]
        for name, values in result["guidance"].items()
    ]
    tables = [
        Table(
            title="Stages",
            columns=["stage", "seconds", "CPU seconds", "peak memory, MB", "artefact"],
            rows=stages,
            note="As computed; a stage that was there already keeps the time it took then.",
        ),
    ]
    if scores := score_rows(result):
        columns, note = score_columns(result["painter"]), SCORE_NOTE
        tables.insert(0, Table(title="Held-out views", columns=columns, rows=scores, note=note))
    if guidance:
        tables.append(
            Table(
                title="Painted views",
                columns=["round", *map(_in_words, GUIDANCE_COLUMNS)],
                rows=guidance,
                note=GUIDANCE_NOTE,
            )
        )
    return tables


def _in_words(name: str) -> str:
    return name.removeprefix("num_").replace("_", " ")


def _plots(histories: Mapping[str, Sequence[Mapping[str, float]]]) -> list[Plot]:
    """The course of every fit of a run, by stage."""

    def lines(key: str) -> dict[str, list[tuple[float, float]]]:
        return {
            name: [(entry["step"], entry[key]) for entry in history]
            for name, history in histories.items()
        }

    return [
        Plot(title="Training views", x_label="step", y_label="PSNR, dB", series=lines("psnr")),
        Plot(title="Size", x_label="step", y_label="Gaussians", series=lines("num_gaussians")),
    ]
