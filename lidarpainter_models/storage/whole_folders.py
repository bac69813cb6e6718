"""Write a folder aside and put it in place whole, or leave nothing.

A folder under construction lies beside its final place as `.<name>.writing-<token>`, locked by the
process that writes it. A process that was killed leaves such a folder unlocked: the next writer of
the same name clears it away.
"""

import errno
import fcntl
import secrets
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from lidarpainter_models.storage.whole_files import storage_errors, sync

_LOCK_NAME = ".writing"
_NUM_SYNC_THREADS = 8


class AsideFolder:
    """A folder that is written beside its final place and then renamed there."""

    def __init__(self, final: Path) -> None:
        self.final = final
        with storage_errors(final):
            final.parent.mkdir(parents=True, exist_ok=True)
            _clear_abandoned(final)
            self.path = final.parent / f".{final.name}.writing-{secrets.token_hex(4)}"
            self.path.mkdir()
            try:
                self._lock = (self.path / _LOCK_NAME).open("wb")
                fcntl.flock(self._lock, fcntl.LOCK_EX)
            except BaseException:
                shutil.rmtree(self.path, ignore_errors=True)
                raise

    def discard(self) -> None:
        """Remove everything written so far."""
        self._lock.close()
        shutil.rmtree(self.path, ignore_errors=True)

    def publish(self) -> None:
        """Force the content to disk and rename the folder into place, replacing what is there."""
        (self.path / _LOCK_NAME).unlink()
        _sync_tree(self.path)
        replaced = self.final.parent / f".{self.final.name}.replaced-{secrets.token_hex(4)}"
        while True:
            try:
                self.path.rename(self.final)
                break
            except OSError as error:
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                    raise
                # a folder with content cannot be renamed over: the old one steps aside first
                self.final.rename(replaced)
                continue
        sync(self.final.parent)
        self._lock.close()
        shutil.rmtree(replaced, ignore_errors=True)


def _clear_abandoned(final: Path) -> None:
    for folder in final.parent.glob(f".{final.name}.writing-*"):
        try:
            with (folder / _LOCK_NAME).open("rb") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
        except OSError:
            continue  # another process writes there now, or has just finished


def _sync_tree(folder: Path) -> None:
    paths = [folder, *folder.rglob("*")]
    with ThreadPoolExecutor(_NUM_SYNC_THREADS) as pool:  # the disk takes many requests at once
        for _ in pool.map(sync, paths):
            pass
