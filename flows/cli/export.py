"""`lidarpainter export`: a run as files of other programs."""

import re
from pathlib import Path
from typing import Annotated, Literal

import typer

from flows.cli.output import print_json, print_pairs
from flows.cli.shared_options import (
    AllowCollisions,
    AsJson,
    BesideWhat,
    FollowedCameras,
    FollowedFrames,
    Fps,
    ImageWidth,
    PostpaintPainter,
    RunName,
    TrajectorySpec,
    followed_path,
    parse_names,
)
from lidarpainter_models.errors import ConfigError

FormatName = Literal[  # `flows.exports.FORMATS`, known before anything is imported
    "ply",
    "spz",
    "gltf",
    "usd",
    "colmap",
    "nerfstudio",
    "video",
    "depth",
    "semantics",
    "page",
    "lidar",
    "lidar-bin",
]
Format = Annotated[
    FormatName,
    typer.Option(
        "--format",
        help="ply, spz, gltf, usd: the scene; colmap, nerfstudio: images with poses; video, depth, "
        "semantics: what is seen; page: the drive in one HTML file; "
        "lidar (PCD), lidar-bin (nuScenes): the sweeps.",
    ),
]
Moment = Annotated[
    str, typer.Option(help="Where actors stand: seconds since the first image, or frame:N.")
]
ActorNames = Annotated[
    str | None, typer.Option(help="Ids of the actors to take along, or none; all if absent.")
]
PerActor = Annotated[
    bool, typer.Option("--per-actor", help="ply: the street and every actor in files of their own.")
]
Sky = Annotated[bool, typer.Option("--sky", help="Show the sky by far Gaussians.")]
SpzVersionOption = Annotated[int, typer.Option(help="3 or 4; fewer programs read 4.")]
Postpaint = Annotated[bool, typer.Option("--postpaint", help="Paint every rendered image.")]


def export(  # noqa: PLR0913 - the options of a command
    run: RunName,
    format_: Format,
    out: Annotated[Path, typer.Option(help="The file, or a new folder.")],
    time: Moment = "0",
    actors: ActorNames = None,
    per_actor: PerActor = False,
    sky: Sky = False,
    spz_version: SpzVersionOption = 3,
    trajectory: TrajectorySpec = "recorded",
    camera: FollowedCameras = None,
    frames: FollowedFrames = None,
    width: ImageWidth = None,
    postpaint: Postpaint = False,
    painter: PostpaintPainter = None,
    fps: Fps = None,
    beside: BesideWhat = None,
    allow_collisions: AllowCollisions = False,
    as_json: AsJson = False,
) -> None:
    """Write a finished run in a format that others read.

    Example: lidarpainter export latest --format gltf --out street.glb

    Images with poses: lidarpainter export latest --format colmap --out dataset --camera all

    A film of the whole rig: lidarpainter export latest --format video --camera all --out rig.mp4
    """
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress

    time_s, frame = parse_time(time)
    scene = {"time_s": time_s, "frame": frame, "actors": parse_actors(actors), "with_sky": sky}
    scene |= {"is_per_actor": per_actor, "spz_version": spz_version}
    path = followed_path(
        run,
        trajectory,
        frames,
        painter,
        camera=camera,
        is_painted=postpaint or painter is not None,
        allows_collisions=allow_collisions,
        width_px=width,
        beside=beside,
    )
    from flows.exports import export_request, export_run

    request = export_request(format_, scene, path, fps)
    with shown_progress():
        result = export_run(existing_store(), request, out.absolute())
    print_json(result) if as_json else print_pairs(f"{format_} of {result['scene']}", result)


def parse_actors(text: str | None) -> tuple[str, ...] | None:
    """Ids with commas between; `none` for no actor, None for all.

    Raises:
        ConfigError: an id is empty.
    """
    return () if text == "none" else parse_names(text)


def parse_time(text: str) -> tuple[float, int | None]:
    """`1.5` as seconds, `frame:12` as a position of the recorded frames.

    Raises:
        ConfigError: the text says something else.
    """
    if match := re.fullmatch(r"frame:(\d{1,9})", text):
        return 0.0, int(match[1])
    if re.fullmatch(r"\d{1,9}(\.\d{1,9})?", text):
        return float(text), None
    raise ConfigError(f"--time {text!r}: expected seconds such as 1.5, or frame:12")
