"""Folders of pairs under the names that tables call them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.training_data.pairs import PairFolder


@dataclass(frozen=True, slots=True, kw_only=True)
class PairSet:
    """A folder of pairs and what tables call it."""

    name: str
    folder: Path

    def open(self) -> PairFolder:
        """The pairs.

        Raises:
            DataError: there are none.
        """
        return PairFolder(self.folder)


def named_sets(folders: Iterable[Path]) -> tuple[PairSet, ...]:
    """Folders of pairs under the shortest ends of their paths that tell them apart."""
    paths = [folder.absolute() for folder in folders]
    if len(set(paths)) != len(paths):
        raise ConfigError("a folder of pairs is given twice")
    depth = 1
    while len({path.parts[-depth:] for path in paths}) < len(paths):
        depth += 1
    return tuple(PairSet(name="/".join(path.parts[-depth:]), folder=path) for path in paths)


def open_sets(sets: Sequence[PairSet]) -> dict[str, PairFolder]:
    """Every set by its name.

    Raises:
        ConfigError: no set, or two of one name.
    """
    folders = {one.name: one.open() for one in sets}
    if not sets or len(folders) != len(sets):
        names = ", ".join(one.name for one in sets)
        raise ConfigError(f"need pairs under names of their own, got {names or 'none'}")
    return folders
