"""The page about a run: its scores, what it took, the course of its fits."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from lidarpainter_models.evaluation.score_tables import (
    ENVELOPE,
    LIDAR,
    MARKINGS,
    SCORE_NOTE,
    TRUSTED,
    score_columns,
    score_rows,
)
from lidarpainter_models.export.pictures import Comparison, MovingPicture, WorstView
from lidarpainter_models.export.report import Cell, Plot, Report, Table
from lidarpainter_models.export.verdict import verdict
from lidarpainter_models.scenes.driving_scene import DrivingScene

DRIVE_PAGE = "drive.html"
"""What the page that plays the drive is called where a command makes it."""
MOST_ACTORS = 20
"""Rows of the table of actors."""
GUIDANCE_COLUMNS = {
    "num_cameras": "cameras beside the path",
    "num_without_room": "of them in a car or a wall",
    "num_refused": "paintings refused",
    "num_views": "painted views fitted",
    "mean_weight": "mean weight of a pixel, 0 to 1",
}
GUIDANCE_NOTE = (
    "The weight says how much a painted pixel counts in the fit: nothing where the painting leaves "
    "the render as it is."
)
HIGHER = "\u2191"
UNITS = {"PSNR": f"PSNR, dB {HIGHER}", "SSIM": f"SSIM {HIGHER}", "depth": f"depth, 0 to 1 {HIGHER}"}
"""Figures with their units, and which way is better."""
HIGHER_NOTE = f"{HIGHER}: higher is better."


@dataclass(frozen=True, slots=True, kw_only=True)
class StageCost:
    """What a stage took when it was computed."""

    stage: str
    seconds: float
    cpu_seconds: float
    peak_memory_bytes: int
    artefact: str
    """Digest of what it made."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pictures:
    """What is drawn of a run."""

    comparisons: Sequence[Comparison] = ()
    moving: MovingPicture | None = None
    worst: Sequence[WorstView] = ()
    actor_gaussians: Mapping[str, int] = field(default_factory=dict)
    """How many Gaussians each fitted actor has, by its id."""
    found: Sequence[str] = ()
    """What was wrong about the recording and is corrected, and its lamps, in sentences."""


@dataclass(frozen=True, kw_only=True)
class RunPage:
    """What is known about a run before anything is drawn."""

    result: Mapping[str, Any]
    """What `reconstruct` prints."""
    costs: Sequence[StageCost]
    provenance: Mapping[str, str]
    settings: Mapping[str, str]
    """Every setting of the run by its dotted name, as `--set` takes it."""
    has_lidar: bool
    """Whether a LiDAR swept in training frames."""
    is_estimated: bool = False
    """Whether points were estimated from images."""

    def report(
        self,
        scene: DrivingScene,
        pictures: Pictures,
        histories: Mapping[str, Sequence[Mapping[str, float]]],
        machine: Mapping[str, str],
    ) -> Report:
        """The page, with images and the course of every fit by stage."""
        return Report(
            title=f"LidarPainter: {self.result['scene']}",
            summary=[_scene_in_words(scene), _summary(self.result)],
            verdict=[*verdict(self.result), *self._estimated(), *pictures.found],
            moving=pictures.moving,
            worst=pictures.worst,
            repeat=_repeat(self.result, json.loads(self.settings.get("train_cameras", "null"))),
            comparisons=pictures.comparisons,
            tables=[
                *_tables(self.result, self.costs),
                *_actors(scene, pictures.actor_gaussians, self.result["recorded"] or {}),
            ],
            plots=_plots(histories),
            facts={"Provenance": self.provenance, "Machine": machine, "Settings": self.settings},
        )

    def _estimated(self) -> list[str]:
        if not self.is_estimated:
            return []
        if self.has_lidar:
            return [
                "The LiDAR tells too little of the street: points estimated from images complete "
                "it, and what guided the painter there is as uncertain as they are."
            ]
        return [
            "No LiDAR swept in the training frames: points are estimated from their images, and "
            "what guided the painter is as uncertain as they are."
        ]


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
    tables = []
    if scores := score_rows(result):
        columns = [_with_unit(name) for name in score_columns(result["painter"])]
        note = f"{SCORE_NOTE} {HIGHER_NOTE}"
        tables.append(Table(title="Held-out views", columns=columns, rows=scores, note=note))
    if by_camera := result.get("recorded_by_camera"):
        rows: list[list[Cell]] = [
            [name, *(values.get(key) for key in ("psnr", "ssim", "actors_psnr", "num_views"))]
            for name, values in by_camera.items()
        ]
        heads = ("PSNR", "SSIM", "inside actor boxes PSNR")
        columns = ["camera", *map(_with_unit, heads), "views"]
        title = "Held-out views by camera"
        tables.append(Table(title=title, columns=columns, rows=rows, note=HIGHER_NOTE))
    if swept := result.get(LIDAR):
        named = {**swept["neurad-studio"], **swept["own"]}
        title = f"Simulated sweeps of {swept['lidar']} against {swept['num_sweeps']} held-out ones"
        figures: list[list[Cell]] = [
            [name, f"{value:.4g}"] for name, value in named.items() if value is not None
        ]
        tables.append(Table(title=title, columns=["figure", "value"], rows=figures))
    if lines := result.get(MARKINGS):
        tables.append(_markings(lines))
    if envelope := result.get(ENVELOPE):
        tables.append(_envelope(envelope))
    tables.append(
        Table(
            title="Stages",
            columns=["stage", "seconds", "CPU seconds", "peak memory, MB", "artefact"],
            rows=[
                [one.stage, one.seconds, one.cpu_seconds, one.peak_memory_bytes / 1e6, one.artefact]
                for one in costs
            ],
            note="As computed; a stage that was there already keeps the time it took then.",
        )
    )
    if guidance := result["guidance"]:
        tables.append(
            Table(
                title="Painted views",
                columns=["round", *GUIDANCE_COLUMNS.values()],
                rows=[
                    [name, *(values[key] for key in GUIDANCE_COLUMNS)]
                    for name, values in guidance.items()
                ],
                note=GUIDANCE_NOTE,
            )
        )
    return tables


def _markings(lines: Mapping[str, Mapping[str, Any]]) -> Table:
    """How well painted lines are told from the road, where the camera was and beside it."""
    named = ("auc", "confirmed_auc", "paint_psnr", "paint_edge_error")
    shown = [name for name in named if any(one.get(name) is not None for one in lines.values())]
    words = {
        "auc": "brighter than the road, AUC",
        "confirmed_auc": "... where LiDAR confirms paint, AUC",
        "paint_psnr": "pixels of lines, PSNR in dB",
        "paint_edge_error": "edges of lines, error",
    }
    told_by = next(iter(lines.values()))["told_by"]
    return Table(
        title="Painted lines",
        columns=["view", *(words[name] for name in shown)],
        rows=[[view, *(one.get(name) for name in shown)] for view, one in lines.items()],
        note=f"Where lines are is told by the LiDAR's {told_by}. AUC: 1 where every point of paint "
        "is brighter than the road around it, 0.5 where no line is to be seen; `image` is what was "
        "recorded. Higher is better, but for edges.",
    )


def _envelope(envelope: Mapping[str, Any]) -> Table:
    """How far each stretch of road can be trusted."""
    rows: list[list[Cell]] = [
        [
            f"{row['from_m']:.0f} to {row['to_m']:.0f}",
            f"{row['first_frame']} to {row['last_frame']}",
            row["recorded_db"],
            row["recorded_confidence"],
            *(row[name] for name in TRUSTED),
        ]
        for row in envelope["stretches"]
    ]
    heads = ["stretch, m", "frames", f"predicted there, dB {HIGHER}", "confidence, 0 to 1"]
    heads += [f"{words}, {unit} {HIGHER}" for words, unit in map(_direction, TRUSTED)]
    return Table(
        title="Where it can be trusted",
        columns=heads,
        rows=rows,
        note=(
            "So far off the recorded path, one way at a time, a frame has "
            f"{envelope['good_db']:g} dB or more with a confidence of at least "
            f"{envelope['promised']:.0%}: the least over {', '.join(envelope['cameras'])} and the "
            "ends of the stretch, predicted from what recorded images and LiDAR say of "
            f"{envelope['num_frames']} frames, without their true images. "
            f"Calibrated on {envelope['calibration']['record']}. {HIGHER_NOTE}"
        ),
    )


def _direction(name: str) -> tuple[str, str]:
    """`yaw_left_deg` as words and unit."""
    words, _, unit = name.rpartition("_")
    return words.replace("_", " "), {"deg": "degrees"}.get(unit, unit)


def _with_unit(name: str) -> str:
    """`painted PSNR` with the unit of its last word, and which way is better."""
    words, _, figure = name.rpartition(" ")
    return f"{words} {UNITS.get(figure, figure)}".strip()


def _actors(
    scene: DrivingScene, num_gaussians: Mapping[str, int], scores: Mapping[str, Any]
) -> list[Table]:
    """The actors that LiDAR saw best, how much of the scene each has, how well each is seen."""
    by_actor = scores.get("psnr_by_actor", {})  # older results have none
    seen = [int(track.num_points.sum()) for track in scene.tracks]
    best = sorted(range(len(seen)), key=lambda index: -seen[index])[:MOST_ACTORS]
    rows: list[list[Cell]] = [
        [
            f"{(track := scene.tracks[index]).category} {track.actor_id}",
            "yes" if track.is_moving else "no",
            " x ".join(f"{side_m:.1f}" for side_m in track.size_m.tolist()),
            len(track.timestamps_ns),
            seen[index],
            num_gaussians.get(track.actor_id),
            by_actor.get(track.actor_id, {}).get("psnr"),
        ]
        for index in best
    ]
    if not rows:
        return []
    columns = ["actor", "moves", "size, m", "frames", "LiDAR points", "Gaussians"]
    columns.append(UNITS["PSNR"])
    note = (
        f"{len(rows)} of {len(seen)}, most points first. What stands still is part of the street. "
        "PSNR: inside the actor's box in held-out views, without what nearer moving boxes cover. "
        f"{HIGHER_NOTE}"
    )
    return [Table(title="Actors", columns=columns, rows=rows, note=note)]


def _repeat(result: Mapping[str, Any], cameras: Sequence[str] | None) -> list[str]:
    """Commands, quoted for a shell."""
    run = str(result["run_id"])
    asked = {name: str(result[name]) for name in ("preset", "painter", "rounds", "split")}
    words = ["lidarpainter", "reconstruct", str(result["scene"])]
    words += [word for name, value in asked.items() for word in (f"--{name}", value)]
    words += ["--train-cameras", ",".join(cameras)] if cameras else []
    return [
        shlex.join(words),
        shlex.join(["lidarpainter", "view", run]),
        shlex.join(["lidarpainter", "export", run, "--format", "page", "--out", DRIVE_PAGE]),
    ]


def _plots(histories: Mapping[str, Sequence[Mapping[str, float]]]) -> list[Plot]:
    """The course of all fits of a run, one after the other, over the time that they took."""
    psnr: dict[str, list[tuple[float, float]]] = {}
    size: dict[str, list[tuple[float, float]]] = {}
    spent_s = 0.0
    for name, history in histories.items():
        timed = [((spent_s + entry["cpu_s"]) / 60, entry) for entry in history]
        psnr[name] = [(minutes, entry["psnr"]) for minutes, entry in timed]
        size[name] = [(minutes, entry["num_gaussians"]) for minutes, entry in timed]
        spent_s += history[-1]["cpu_s"] if history else 0.0
    x_label = "CPU minutes of fitting"
    return [
        Plot(title="Training views", x_label=x_label, y_label="PSNR, dB", series=psnr),
        Plot(title="Size", x_label=x_label, y_label="Gaussians", series=size),
    ]
