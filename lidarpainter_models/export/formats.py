"""The formats that a run is exported in, one row each: help, checks and dispatch read this table.

Importing it is cheap: a row names its writer, which is imported when somebody writes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

from lidarpainter_models.errors import ConfigError

FormatKind = Literal["scene", "dataset", "views", "page", "sweeps", "simulated", "bundle", "log"]
"""What a format holds: the fitted scene, recorded images with poses, views along a trajectory, a
page that plays the drive, recorded LiDAR sweeps, simulated ones, all that a simulator loads, or the
recorded log, for which no run is needed."""

SWEEP_FORMATS = ("pcd", "pcd.bin", "npz", "parquet")
"""Formats of LiDAR sweeps, by how their files end."""

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
    writer: str = ""
    """`module:function` that writes a file of a scene, a dataset or a sweep. Writers of scenes are
    called with a path, the `SceneContents` and `time`, which of its moments is shown."""
    reader: str | None = None
    """`module:function` that reads a scene back; None where the file keeps every number."""
    endings: tuple[str, ...] = ()
    """How the name of its file may end, in lower case; without any it is a new folder."""
    may_be_folder: bool = False
    """Whether a folder is written where the name of a file could stand too."""
    options: tuple[str, ...]
    """The options of `export` that it has a use for, beside the run and `--out`."""
    is_moving: bool = False
    """Whether it holds a sequence of moments; other formats of scenes hold one."""
    takes_assets: bool = False
    """Whether single assets are exported in it too."""

    @property
    def holds_recorded(self) -> bool:
        """Whether it holds what was recorded, which a changed run no longer shows."""
        return self.kind in ("dataset", "sweeps", "log")

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
        takes_assets=True,
    ),
    ExportFormat(
        name="gltf",
        kind="scene",
        summary="the scene as .glb, its actors as animated nodes",
        writer=f"{_HERE}.gltf_files:write_gltf",
        endings=(".glb",),
        options=_WHEN,
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
        is_moving=True,
        takes_assets=True,
    ),
    ExportFormat(
        name="colmap",
        kind="dataset",
        summary="recorded images, refined poses and LiDAR points for COLMAP",
        writer=f"{_HERE}.datasets:write_colmap",
        options=(*_WHERE, "--postpaint"),
    ),
    ExportFormat(
        name="nerfstudio",
        kind="dataset",
        summary="the same for nerfstudio",
        writer=f"{_HERE}.datasets:write_nerfstudio",
        options=(*_WHERE, "--postpaint"),
    ),
    ExportFormat(
        name="video",
        kind="views",
        summary="a film of what is seen along a trajectory",
        endings=(".mp4",),
        may_be_folder=True,
        options=(*_WHERE, "--postpaint", "--fps", "--beside"),
    ),
    ExportFormat(
        name="depth",
        kind="views",
        summary="depth along a trajectory, as 16-bit PNG in 256ths of a metre",
        options=_WHERE,
    ),
    ExportFormat(
        name="semantics",
        kind="views",
        summary="who is where along a trajectory, as 16-bit PNG",
        options=_WHERE,
    ),
    ExportFormat(
        name="page",
        kind="page",
        summary="the drive in one HTML file that plays from the disk",
        endings=(".html", ".htm"),
        options=(*_WHERE, "--postpaint", "--beside"),  # the last two are refused with a reason
    ),
    ExportFormat(
        name="lidar", kind="sweeps", summary="recorded LiDAR sweeps as PCD", options=("--frames",)
    ),
    ExportFormat(
        name="lidar-bin",
        kind="sweeps",
        summary="recorded LiDAR sweeps as nuScenes' .pcd.bin",
        options=("--frames",),
    ),
    ExportFormat(
        name="sweeps",
        kind="simulated",
        summary="simulated LiDAR sweeps along a trajectory, as Parquet",
        options=("--trajectory", "--frames"),
    ),
    ExportFormat(
        name="ncore",
        kind="log",
        summary="the recorded log as NVIDIA's NCore V4, of a scene without a run too",
        writer=f"{_HERE}.ncore_files:write_ncore",
        options=("--frames",),
    ),
    ExportFormat(
        name="simulator",
        kind="bundle",
        summary="scene, rig, tracks, meshes and map in the .usdz that driving simulators load",
        writer=f"{_HERE}.simulator_bundle:write_bundle",
        endings=(".usdz",),
        options=(),
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
