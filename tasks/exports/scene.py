"""Write a fitted scene as a file that viewers and engines read: PLY, SPZ, glTF, USD."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.export.contents import FRAME, SceneContents, fidelity, scene_contents
from lidarpainter_models.export.formats import ExportFormat
from lidarpainter_models.export.view_requests import ViewRequest
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.ply_files import write_ply
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.observations.views import SceneObservations
from tasks.exports.places import STAGE, new_folder
from tasks.opened import opened
from tasks.progress import listener
from tasks.specs import FittedRef, RunSpec
from tasks.stored import load_observations, load_scene
from tasks.views.render import ViewedRun, followed_paths, write_paths

VIDEO_ENDING = ".mp4"


def export_video(viewed: ViewedRun, request: ViewRequest, out: Path) -> dict[str, Any]:
    """Write a film: to a name in `.mp4` all cameras together, else a folder with one of each.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
        ConfigError: one camera's film is not called as films are, or a folder is there already.
        WriteError: the disk refuses; nothing is left half-written.
    """
    paths = followed_paths(viewed, request)
    is_film = out.suffix.lower() == VIDEO_ENDING
    if len(paths) == 1 and not is_film:
        raise ConfigError(f"{out.name}: expected a name in {VIDEO_ENDING}")
    if is_film:
        films, together = ([out], None) if len(paths) == 1 else ([], out)
        places = [out.parent] * len(paths)
        made = write_paths(viewed, paths, request, places, films=films, together=together)
    else:
        with new_folder(out) as folder:
            films = [folder / f"{path.camera_name}{VIDEO_ENDING}" for path in paths]
            made = write_paths(viewed, paths, request, [folder] * len(paths), films=films)
    return {"path": str(out), **_of_export(made)}


def export_images(viewed: ViewedRun, request: ViewRequest, out: Path) -> dict[str, Any]:
    """Write depth or semantics of every view into a new folder, a folder for each camera.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
        ConfigError: something is there already.
        WriteError: the disk refuses; nothing is left half-written.
    """
    paths = followed_paths(viewed, request)
    with new_folder(out) as folder:
        places = [folder / path.camera_name if len(paths) > 1 else folder for path in paths]
        made = write_paths(viewed, paths, request, places)
    return {"path": str(out), **_of_export(made)}


def _of_export(made: dict[str, Any]) -> dict[str, Any]:
    return {
        name: value for name, value in made.items() if name not in ("collisions", "num_trusted")
    }


_NUM_COMPARED = 3
"""Cameras by which a loss is measured: at the beginning, the middle and the end of the drive."""


@dataclass(frozen=True, kw_only=True)
class SceneRequest:
    """Which parts of a scene are wanted, when, and in which format."""

    time_s: float = 0.0
    """Seconds since the first image of the log, when actors stand where they are."""
    frame: int | None = None
    """The position of a recorded frame in place of a time."""
    actors: tuple[str, ...] | None = None
    """Ids of those to take along; None takes all."""
    is_per_actor: bool = False
    """PLY only: a folder with the street and every actor in its box frame."""
    with_sky: bool = False
    """Whether far Gaussians show the sky; otherwise there is none."""
    spz_version: int = 3
    """Version of SPZ, 3 or 4."""

    def __post_init__(self) -> None:
        """Refuse versions that there are not.

        Raises:
            ConfigError: one of these.
        """
        if self.spz_version not in (3, 4):
            raise ConfigError(f"--spz-version {self.spz_version}: expected 3 or 4")

    def check(self, row: ExportFormat, out: Path) -> None:
        """Refuse what cannot be written, before anything is opened.

        Raises:
            ConfigError: the name ends otherwise, or parts are asked of a format without.
        """
        if self.is_per_actor and not row.may_be_folder:
            raise ConfigError(f"parts are written as ply, not as {row.name}")
        if not self.is_per_actor and out.suffix.lower() not in row.endings:
            raise ConfigError(f"{out.name}: expected a name in {', '.join(row.endings)}")


def export_scene(
    run: RunSpec, fitted: FittedRef, row: ExportFormat, request: SceneRequest, out: Path
) -> dict[str, Any]:
    """Write the scene, and say how much is in it and what the format loses.

    Raises:
        ConfigError: see `SceneRequest.check`, or a time outside of the log.
        SceneError: no such actor, or none at all where only actors are wanted.
        WriteError: the disk refuses; nothing is left half-written.
    """
    request.check(row, out)
    this = opened(run)
    listener().started(STAGE)
    scene = load_scene(this.store, fitted.gaussians)
    seen = load_observations(this.store, fitted.observations)
    times_ns = sorted({view.timestamp_ns for view in this.scene.views_of(seen.camera_names[0])})
    time_ns = _moment(times_ns, request)
    baked = scene.baked(time_ns)  # no format knows fog or lamps: colours as its style has them
    contents = scene_contents(
        baked,
        run.split.scene_id,
        times_ns if row.is_moving else [time_ns],
        actors=request.actors,
        with_sky=request.with_sky,
    )
    if request.is_per_actor and not contents.actors:
        raise SceneError(f"scene {contents.name} has no moving actor: leave --per-actor out")
    nearest = min(range(len(times_ns)), key=lambda n: abs(times_ns[n] - time_ns))
    shown = nearest * row.is_moving
    files = _write(row, request, contents, shown, out)
    listener().advanced(STAGE, 1, 2, "written")
    placed_ns = times_ns[shown] if row.is_moving else time_ns
    read = None if request.is_per_actor else row.load_reader()
    exported = contents.placed(shown) if read is None else read(out)
    said: dict[str, Any] = {"psnr": None, "psnr_reason": "actors were chosen"}
    if request.actors is None:
        sky = None if request.with_sky else baked.sky
        lost = fidelity(scene, exported, placed_ns, _compared_cameras(scene, seen), sky=sky)
        said = {"psnr": lost.psnr_db, "worst_psnr": lost.worst_psnr_db}
    listener().advanced(STAGE, 2, 2, "compared")
    return {
        "path": str(out),
        "num_bytes": sum(file.stat().st_size for file in files),
        "num_gaussians": contents.num_gaussians if row.is_moving else len(exported),
        "num_actors": len(contents.actors),
        "time_s": (placed_ns - times_ns[0]) * 1e-9,
        "frame": FRAME,
        "sky": "far Gaussians" if request.with_sky else "left out",
        **said,
    }


def _moment(times_ns: list[int], request: SceneRequest) -> int:
    """When the scene is wanted."""
    if request.frame is not None:
        if request.frame >= len(times_ns):
            raise ConfigError(f"--time frame:{request.frame}: expected 0 to {len(times_ns) - 1}")
        return times_ns[request.frame]
    last_s = (times_ns[-1] - times_ns[0]) * 1e-9
    if not 0 <= request.time_s <= last_s + 1e-6:
        raise ConfigError(f"--time {request.time_s:g}: expected 0 to {last_s:.3f} s")
    return times_ns[0] + round(request.time_s * 1e9)


def _write(
    row: ExportFormat, request: SceneRequest, contents: SceneContents, shown: int, out: Path
) -> list[Path]:
    """Write the wanted format; the files that were made."""
    if request.is_per_actor:
        return _write_parts(contents, out)
    has_versions = "--spz-version" in row.options
    versions: dict[str, Any] = {"version": request.spz_version} if has_versions else {}
    row.load_writer()(out, contents, time=shown, **versions)
    return [out]


def _write_parts(contents: SceneContents, out: Path) -> list[Path]:
    """The street as `street.ply`, actors in numbered files that name them in a comment."""
    with new_folder(out) as folder:
        write_ply(folder / "street.ply", contents.street, (f"{contents.name}: {FRAME}",))
        for number, actor in enumerate(contents.actors):
            length_m, width_m, height_m = actor.size_m.tolist()
            said = (
                f"actor {actor.actor_id} of {contents.name}, {actor.category}",
                "box frame: x along the length, y left, z up, origin at the centre; metres",
                f"box of {length_m:.2f} x {width_m:.2f} x {height_m:.2f} m",
            )
            write_ply(folder / f"actor-{number:03d}.ply", actor.gaussians, said)
    return sorted(out.glob("*.ply"))


def _compared_cameras(scene: GaussianScene, seen: SceneObservations) -> list[Camera]:
    last = len(seen.views) - 1
    rows = sorted({round(last * part / (_NUM_COMPARED - 1)) for part in range(_NUM_COMPARED)})
    return [scene.refined_camera(seen.views[row]) for row in rows]
