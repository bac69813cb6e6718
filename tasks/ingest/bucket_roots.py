"""A dataset whose root is `s3://BUCKET/PREFIX`: fetched a sequence at a time, read as a folder.

A sequence is all that lies below the folder of its name, directly below the root, or the files
there whose names begin with it. They are fetched into a folder of the cache, read into the store,
and let go; so no more than the sequences that are being read lies on the disk. Datasets that spread
a sequence over several folders cannot be read so.
"""

import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from catalog.buckets import Bucket
from catalog.errors import storage_errors
from catalog.folders import cache_folder, make_writable
from catalog.mirrors import AT_ONCE
from lidarpainter_models.errors import DataError


def is_in_bucket(root: Path) -> bool:
    """Whether a root is in a bucket; a `Path` has made one slash of the two."""
    return str(root).startswith("s3:/")


def normal_root(root: Path) -> str:
    """A root by which it is known everywhere: absolute, or an address."""
    return Bucket(str(root)).address if is_in_bucket(root) else str(Path(root).resolve())


def sequences_in_bucket(root: Path) -> tuple[str, ...]:
    """The folders directly below a root.

    Raises:
        DataError: there is none.
        StorageError: the bucket does not answer, or is not there.
    """
    bucket = Bucket(str(root))
    found = tuple(sorted({name.split("/")[0] for name in bucket.sizes("") if "/" in name}))
    if not found:
        raise DataError(f"{bucket.address}: nothing is there, expected a folder for each sequence")
    return found


@contextmanager
def root_at_hand(root: Path, sequence: str, *, only: str | None = None) -> Iterator[Path]:
    """A folder that holds this sequence of a root, or one file of it, while the block runs.

    Raises:
        DataError: the bucket has nothing of this sequence, or a name that leads elsewhere.
        StorageError: it cannot be fetched.
    """
    if not is_in_bucket(root):
        yield root
        return
    bucket = Bucket(str(root))
    names = [one for one in bucket.sizes(sequence) if only in (None, Path(one).name)]
    if not names:
        names = [name for name in bucket.sizes("") if name.startswith(f"{sequence}.")]
    if not names:
        raise DataError(f"{bucket.address}: no folder or file of sequence {sequence} is there")
    make_writable(cache_folder(), "the cache")
    with tempfile.TemporaryDirectory(prefix="dataset-", dir=cache_folder()) as folder:
        with ThreadPoolExecutor(AT_ONCE) as pool, storage_errors(f"cannot write {folder}"):
            list(pool.map(lambda name: _fetch(bucket, name, Path(folder)), names))
        yield Path(folder)


def _fetch(bucket: Bucket, name: str, folder: Path) -> None:
    path = folder / name
    if ".." in Path(name).parts or path == folder:
        raise DataError(f"{bucket.where(name)}: a name that leads elsewhere")
    path.parent.mkdir(parents=True, exist_ok=True)
    if bucket.download(name, path) is None:
        raise DataError(f"{bucket.where(name)}: it is gone, though it was listed a moment ago")
