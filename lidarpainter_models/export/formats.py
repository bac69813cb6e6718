"""The formats that a run is exported in, one row each: help, checks and dispatch read this table.

Importing it is cheap: a row names its writer, which is imported when somebody writes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

from lidarpainter_models.errors import ConfigError

FormatKind = Literal["scene", "dataset", "views", "page", "sweeps"]
"""What a format holds: the fitted scene, recorded images with poses, views along a trajectory, a
page that plays the drive, or recorded LiDAR sweeps."""

_WHERE = ("--trajectory", "--camera", "--frames", "--width")
_WHEN = ("--time", "--actors", "--sky")


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportFormat:
    """One format of `lidarpainter export`."""

    name: str
    """What follows `--format`."""
    kind: FormatKind
    summary: str
    """What it is, for a line of help."""
    writer: str
    """`module:function` that writes a file of it. Writers of scenes are called with a path, the
    `SceneContents` and `time`, which of its moments is shown."""
    reader: str | None = None
    """`module:function` that reads a scene back; None where the file keeps every number."""
    endings: tuple[str, ...] = ()
    """How the name of its file may end, in lower case; without any it is a new folder."""
    may_be_folder: bool = False
    """Whether a folder is written where the name of a file could stand too."""
    options: tuple[str, ...]
    """The options of `export` that it has a use for, beside the run and `--out`."""
    loses: str
    """What of a scene or drive such a file cannot say."""
    extra: str | None = None
    """The extra of the package that has to be installed."""
    is_moving: bool = False
    """Whether it holds a sequence of moments; other formats of scenes hold one."""
    takes_assets: bool = False
    """Whether single assets are exported in it too."""

    @property
    def holds_recorded(self) -> bool:
        """Whether it holds what was recorded, which a changed run no longer shows."""
        return self.kind in ("dataset", "sweeps")

    def load_writer(self) -> Callable[..., Any]:
        """The function that writes it; imports whatever that needs."""
        return _loaded(self.writer)

    def load_reader(self) -> Callable[..., Any] | None:
        """The function that reads it back, or None; imports whatever that needs."""
        return None if self.reader is None else _loaded(self.reader)


def _loaded(place: str) -> Callable[..., Any]:
    module, _, name = place.partition(":")
    found: Callable[..., Any] = getattr(import_module(module), name)
    return found


_HERE = "lidarpainter_models.export"
_LOSES_STILL = "motion, and the exposure of cameras; sky and style are baked or left out"
_LOSES_MOVING = "the exposure of cameras; lamps that blink, bodies that bend; sky and style"

FORMATS: tuple[ExportFormat, ...] = (
    ExportFormat(
        name="ply",
        kind="scene",
        summary="the scene at one moment, as splat viewers read it",
        writer=f"{_HERE}.contents:write_ply_scene",
        reader="lidarpainter_models.gaussians.model.ply_files:read_ply",
        endings=(".ply",),
        may_be_folder=True,
        options=(*_WHEN, "--per-actor"),
        loses=_LOSES_STILL,
        takes_assets=True,
    ),
    ExportFormat(
        name="spz",
        kind="scene",
        summary="the scene at one moment in a quarter of the bytes",
        writer=f"{_HERE}.spz_files:write_spz_scene",
        reader=f"{_HERE}.spz_files:read_spz",
        endings=(".spz",),
        options=(*_WHEN, "--spz-version"),
        loses=f"{_LOSES_STILL}; numbers are rounded to 8 bits",
        extra="export",
        takes_assets=True,
    ),
    ExportFormat(
        name="gltf",
        kind="scene",
        summary="the scene as .glb, its actors as animated nodes",
        writer=f"{_HERE}.gltf_files:write_gltf",
        endings=(".glb",),
        options=_WHEN,
        loses=_LOSES_MOVING,
        is_moving=True,
        takes_assets=True,
    ),
    ExportFormat(
        name="usd",
        kind="scene",
        summary="the scene as OpenUSD, its actors animated",
        writer=f"{_HERE}.usd_files:write_usd",
        endings=(".usdz", ".usdc", ".usda"),
        options=_WHEN,
        loses=_LOSES_MOVING,
        extra="export",
        is_moving=True,
    ),
    ExportFormat(
        name="colmap",
        kind="dataset",
        summary="recorded images, refined poses and LiDAR points for COLMAP",
        writer=f"{_HERE}.datasets:write_colmap",
        options=(*_WHERE, "--postpaint"),
        loses="actors, LiDAR sweeps, times",
    ),
    ExportFormat(
        name="nerfstudio",
        kind="dataset",
        summary="the same for nerfstudio",
        writer=f"{_HERE}.datasets:write_nerfstudio",
        options=(*_WHERE, "--postpaint"),
        loses="actors, LiDAR sweeps",
    ),
    ExportFormat(
        name="video",
        kind="views",
        summary="a film of what is seen along a trajectory",
        writer=f"{_HERE}.videos:video_file",
        endings=(".mp4",),
        may_be_folder=True,
        options=(*_WHERE, "--postpaint", "--fps", "--beside"),
        loses="geometry; colours are compressed",
    ),
    ExportFormat(
        name="depth",
        kind="views",
        summary="depth along a trajectory, as 16-bit PNG in 256ths of a metre",
        writer=f"{_HERE}.images:write_depth_png",
        options=_WHERE,
        loses="colours; what is farther than 256 m",
    ),
    ExportFormat(
        name="semantics",
        kind="views",
        summary="who is where along a trajectory, as 16-bit PNG",
        writer=f"{_HERE}.images:write_index_png",
        options=_WHERE,
        loses="colours; parked cars are part of the street",
    ),
    ExportFormat(
        name="page",
        kind="page",
        summary="the drive in one HTML file that plays from the disk",
        writer=f"{_HERE}.page:sealed_page",
        endings=(".html", ".htm"),
        options=(*_WHERE, "--postpaint", "--beside"),  # the last two are refused with a reason
        loses="colours that change with the direction; a style stands still",
    ),
    ExportFormat(
        name="lidar",
        kind="sweeps",
        summary="recorded LiDAR sweeps as PCD",
        writer=f"{_HERE}.lidar_files:write_pcd",
        options=("--frames",),
        loses="images, boxes, the scene",
    ),
    ExportFormat(
        name="lidar-bin",
        kind="sweeps",
        summary="recorded LiDAR sweeps as nuScenes' .pcd.bin",
        writer=f"{_HERE}.lidar_files:write_pcd_bin",
        options=("--frames",),
        loses="images, boxes, the scene; times of single points",
    ),
)
FORMAT_NAMES = tuple(row.name for row in FORMATS)


def export_format(name: str) -> ExportFormat:
    """The row of a format.

    Args:
        name: what stands after `--format`.

    Raises:
        ConfigError: there is no such format.
    """
    for row in FORMATS:
        if row.name == name:
            return row
    raise ConfigError(f"--format {name!r}: expected one of {', '.join(FORMAT_NAMES)}")


def formats_help() -> str:
    """One sentence for each format, as the help of `--format` shows it."""
    return "; ".join(f"{row.name}: {row.summary}" for row in FORMATS) + "."
