"""The files of others that become assets, one row each: help, checks and dispatch read this table.

Importing it is cheap: what reads a format is imported when somebody reads.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from lidarpainter_models.errors import ConfigError

if TYPE_CHECKING:
    from lidarpainter_models.assets.foreign_files import ForeignFolder, ForeignShape

Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
"""A direction in the frame of a file."""


def _ply(folder: "ForeignFolder") -> "ForeignShape":
    from lidarpainter_models.assets.foreign_splats import holds_splats, read_ply_splats

    return read_ply_splats(folder) if holds_splats(folder) else _mesh(folder)


def _spz(folder: "ForeignFolder") -> "ForeignShape":
    from lidarpainter_models.assets.foreign_splats import read_spz_splats

    return read_spz_splats(folder)


def _mesh(folder: "ForeignFolder") -> "ForeignShape":
    from lidarpainter_models.assets.foreign_meshes import read_meshes

    return read_meshes(folder)


def _gltf(folder: "ForeignFolder") -> "ForeignShape":
    from lidarpainter_models.assets.foreign_meshes import read_gltf

    return read_gltf(folder)


def _usd(folder: "ForeignFolder") -> "ForeignShape":
    from lidarpainter_models.assets.foreign_usd import read_usd

    return read_usd(folder)


@dataclass(frozen=True, slots=True)
class ImportFormat:
    """One format of `lidarpainter assets import`."""

    endings: tuple[str, ...]
    """How the name of a file ends, in lower case."""
    summary: str
    """What it holds, for a line of help."""
    read: Callable[["ForeignFolder"], "ForeignShape"]
    """Reads the file of a folder, in its own frame."""
    up: Axis
    """The axis that points up, if neither the file nor the user says which."""
    forward: Axis
    """The axis along which things of this format look by custom, while `up` is their up."""


IMPORT_FORMATS = (
    ImportFormat((".ply",), "Gaussian splats, or a mesh with colours", _ply, "z", "x"),
    ImportFormat((".spz",), "Gaussian splats", _spz, "y", "-z"),
    ImportFormat((".obj",), "a mesh with its .mtl and textures", _mesh, "y", "z"),
    ImportFormat((".glb", ".gltf"), "meshes with materials", _gltf, "y", "z"),
    ImportFormat((".usdz", ".usdc", ".usda", ".usd"), "meshes with materials", _usd, "y", "z"),
)


def import_format(path: Path) -> ImportFormat:
    """The row of a file, by its name.

    Raises:
        ConfigError: there is no such format.
    """
    for row in IMPORT_FORMATS:
        if path.suffix.lower() in row.endings:
            return row
    known = ", ".join(ending for row in IMPORT_FORMATS for ending in row.endings)
    raise ConfigError(f"{path.name}: expected a name in {known}")


def import_help() -> str:
    """One line for each format."""
    return "; ".join(f"{', '.join(row.endings)}: {row.summary}" for row in IMPORT_FORMATS)
