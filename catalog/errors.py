"""What can go wrong in the store, each also a built-in type.

The catalog is a stranger to the library, so it has errors of its own; the command line turns both
families into one line and exit code 2.
"""

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager


class CatalogError(Exception):
    """The store cannot do what was asked of it."""


class StorageError(CatalogError, OSError):
    """The store cannot be written or read: disk full, permissions, a broken disk."""


class UnreachableError(StorageError):
    """A bucket did not answer, or not in time, however often it was asked; it may be back later."""


class DamagedArtefactError(CatalogError, ValueError):
    """A stored artefact is not what its manifest says."""


class UnknownRecordError(CatalogError, LookupError):
    """The catalog holds no such scene, run or artefact, or more than one matches."""


class IdentityError(CatalogError, TypeError):
    """A configuration holds something that has no canonical form, so it has no digest."""


class ConflictError(CatalogError, RuntimeError):
    """Others were in the way: they won every commit to a table, or asked otherwise meanwhile."""


REASONS = {
    errno.ENOSPC: "no space left on the device",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "the file would be larger than is allowed",
    errno.EROFS: "the file system is read-only",
    errno.EACCES: "permission denied",
    errno.EPERM: "operation not permitted",
    errno.EIO: "input/output error",
    errno.ENOTDIR: "a part of the path is not a folder",
    errno.EEXIST: "a file is in the way",
}

LONGEST_REASON = 160
_METADATA_SERVICE = "169.254.169.254"
"""Asked for credentials where nothing else has them; there is one on Amazon's machines alone."""
_DECORATION = re.compile("\x1b\\[[0-9;]*m|↳")
_FOREIGN_CODE = re.compile(r"\(os error (\d+)\)|\bOs \{ code: (\d+),")


@contextmanager
def storage_errors(doing: str) -> Iterator[None]:
    """Turn a failing disk into one clear `StorageError`; everything else passes.

    Writers in Rust (safetensors, Delta) report a full disk only in their text, as `(os error 28)`
    or `Os { code: 28, ...`, so that is read too.
    """
    try:
        yield
    except StorageError:
        raise
    except Exception as error:
        code = disk_error(error)
        if code is None:
            raise
        raise StorageError(f"{doing}: {REASONS[code]}") from error


def disk_error(error: BaseException) -> int | None:
    """The errno of the failing disk behind an error or its causes, or None."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, OSError) and seen.errno in REASONS:
            return seen.errno
        if found := _FOREIGN_CODE.search(str(seen)):
            code = int(found[1] or found[2])
            return code if code in REASONS else None
        seen = seen.__cause__
    return None


def reason_of(error: BaseException) -> str:
    """Why a bucket did not do what was asked, in one line: clients in Rust fill a page."""
    text = " ".join(_DECORATION.sub(" ", str(error)).split())
    if _METADATA_SERVICE in text:
        return "no credentials: AWS_ACCESS_KEY_ID, ~/.aws/credentials or a role of this machine"
    end = text.partition(" Debug source:")[0].rpartition(" - ")[2]
    return re.split(r":? <", end)[0][:LONGEST_REASON]
