"""What somebody else's file holds, and the folder that it may read: its own, and nothing beyond.

Such a file names others (materials, textures, buffers, layers). Names that lead out of its folder,
or to the network, are refused; so is what is not there, for a car would come without its colours.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote

from lidarpainter_models.assets.import_formats import Axis
from lidarpainter_models.errors import DataError
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet

if TYPE_CHECKING:
    from trimesh import Trimesh

MOST_BYTES = 512 * 2**20
"""Limit on the size of all files of one asset together."""
UNREADABLE = (
    *(ArithmeticError, AssertionError, AttributeError, ImportError, LookupError, MemoryError),
    *(OSError, RuntimeError, SyntaxError, TypeError, ValueError),
)
"""Errors that other people's readers raise about a damaged file."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ForeignShape:
    """What a file holds, in its own frame and unit: Gaussians or meshes."""

    gaussians: GaussianSet | None = None
    meshes: Sequence["Trimesh"] = ()
    up: Axis | None = None
    """None where the file does not say."""
    unit_m: float = 1.0
    size_m: tuple[float, float, float] | None = None
    """Length, width and height of a file that stands in our box frame and says so."""
    is_linear: bool = False
    """Whether colours of vertices and factors of materials are linear light."""


class ForeignFolder:
    """The folder of a file, as trimesh asks for what a file names."""

    def __init__(self, file: Path) -> None:
        """Take the folder that a file is in.

        Raises:
            DataError: there is no such file.
        """
        if not file.is_file():
            raise DataError(f"{file} is not there: expected a file to import")
        self.file = file.resolve()
        self.digests: dict[Path, str] = {}
        """SHA-256 of all that was read."""
        self.problem: str | None = None
        """The last refusal: trimesh passes over what it was refused, its caller must look here."""

    @property
    def content(self) -> bytes:
        """The file itself; raises as `get` does."""
        return self.get(self.file.name)

    @property
    def contents(self) -> list[tuple[str, str]]:
        """All that was read: its place in the folder (none for the file itself), and SHA-256.

        Two textures that change places make another car; another name for the file does not.
        """
        names = {one: one.relative_to(self.file.parent).as_posix() for one in self.digests}
        names[self.file] = ""
        return sorted((names[one], digest) for one, digest in self.digests.items())

    def get(self, name: str) -> bytes:
        """The bytes of something that the file names, as it is or percent-encoded as in a URI.

        Raises:
            DataError: it leads out of the folder, is not there, or is too large with all others.
        """
        before, self.problem = self.problem, f"{self.file}: names {name[:200]!r}, which is no file"
        path = self._place(name)
        if not path.is_file():
            path = self._place(unquote(name))
        if not path.is_relative_to(self.file.parent):
            self.problem = f"{self.file}: names {name[:200]!r}, expected a file of its own folder"
        elif not path.is_file():
            self.problem = f"{self.file}: names {name[:200]!r}, which is not there"
        elif sum(one.stat().st_size for one in {*self.digests, path}) > MOST_BYTES:
            self.problem = f"{self.file}: with what it names larger than {MOST_BYTES >> 20} MB"
        else:
            content = path.read_bytes()
            self.digests[path] = hashlib.sha256(content).hexdigest()
            self.problem = before
            return content
        raise DataError(self.problem)

    __getitem__ = get

    def _place(self, name: str) -> Path:
        return (self.file.parent / name.strip().replace("\\", "/")).resolve()
