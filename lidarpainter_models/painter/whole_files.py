"""Files that are there whole or not at all."""

import secrets
from contextlib import suppress
from pathlib import Path

from lidarpainter_models.scenes.publishing import storage_errors


def write_whole(path: Path, content: bytes) -> None:
    """Write a file aside and rename it; an older file stays if that fails.

    Raises:
        StorageError: the disk refuses.
    """
    aside = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            aside.write_bytes(content)
            aside.replace(path)
        except BaseException:
            with suppress(OSError):
                aside.unlink()
            raise
