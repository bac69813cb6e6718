"""Where exports are written: folders that held nothing before, and that are there whole or not."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.storage.whole_files import storage_errors
from lidarpainter_models.storage.whole_folders import AsideFolder


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Give a folder beside `out` to write to, then rename it there.

    Raises:
        ConfigError: a file or a folder with content is there.
        WriteError: the disk refuses.
    """
    is_free = not any(out.iterdir()) if out.is_dir() else not (out.exists() or out.is_symlink())
    if not is_free:
        raise ConfigError(f"{out} is there already: expected a new or an empty folder")
    folder = AsideFolder(out)
    try:
        with storage_errors(out):
            yield folder.path
            folder.publish()
    except BaseException:
        folder.discard()
        raise
