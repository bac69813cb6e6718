"""Where exports are written: folders that held nothing before, and that are there whole or not."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.storage.whole_files import storage_errors
from lidarpainter_models.storage.whole_folders import AsideFolder

STAGE = "export"
"""What listeners are told of every export."""


@contextmanager
def new_folder(out: Path, *, replaces: Collection[str] = ()) -> Iterator[Path]:
    """Give a folder beside `out` to write to, then rename it there.

    Args:
        out: a new or an empty folder.
        replaces: names in a folder that may be written over, if it holds all of them.

    Raises:
        ConfigError: a file or a folder with other content is there.
        WriteError: the disk refuses; what was there before stays.
    """
    names = {path.name for path in out.iterdir()} if out.is_dir() else set()
    is_ours = bool(replaces) and names >= set(replaces)
    if (names and not is_ours) or (not out.is_dir() and (out.exists() or out.is_symlink())):
        raise ConfigError(f"{out} is there already: expected a new or an empty folder")
    folder = AsideFolder(out)
    try:
        with storage_errors(out):
            yield folder.path
            folder.publish()
    except BaseException:
        folder.discard()
        raise
