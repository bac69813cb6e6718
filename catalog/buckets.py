"""Objects below a prefix of a bucket: read, written on a condition, listed, removed.

The address is `s3://BUCKET/PREFIX`. Credentials, region and endpoint come from the environment as
Amazon names it (`AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, `AWS_SESSION_TOKEN`, `AWS_REGION`,
`AWS_ENDPOINT_URL`), from its files (`~/.aws/credentials`, `~/.aws/config`, `AWS_PROFILE`), or from
the role of the machine; they are never written anywhere.

What fails for the moment (503, a lost connection, no answer) is tried again with growing pauses, a
bounded number of times; then it is an `UnreachableError` of one line. An answer may be lost after
the object was written: a conditional write that is then refused looks whether what is there is its
own, so contents that are written on a condition must be unique.
"""

import configparser
import hashlib
import os
import re
import secrets
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import obstore
from obstore.exceptions import (
    AlreadyExistsError,
    BaseError,
    PermissionDeniedError,
    PreconditionError,
    UnauthenticatedError,
)
from obstore.store import S3Store

from catalog.errors import CatalogError, StorageError, UnreachableError, reason_of
from catalog.folders import expanded

if TYPE_CHECKING:
    from obstore import ObjectMeta, PutMode

SCHEME = "s3://"
_ADDRESS = re.compile(r"s3:/{1,2}([a-z0-9][a-z0-9.-]{1,61}[a-z0-9])(/.*)?")
_PART = re.compile(r"[A-Za-z0-9][A-Za-z0-9._=-]*")
ANSWER_S = 30
"""The longest that one request may take."""
RETRIES = 8
RETRY_S = 60
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 5.0
PART_BYTES = 16 << 20
"""Larger files go up in parts of this size, and come down in pieces of it."""
_AMAZON_FILES = {
    "AWS_CONFIG_FILE": "~/.aws/config",
    "AWS_SHARED_CREDENTIALS_FILE": "~/.aws/credentials",
}
_KEYS = ("aws_access_key_id", "aws_secret_access_key", "aws_session_token", "region")


def normal_address(text: str) -> str:
    """`s3://BUCKET/PREFIX` with two slashes and none at the end.

    Raises:
        CatalogError: that is no such address.
    """
    found = _ADDRESS.fullmatch(text.rstrip("/"))
    parts = (found[2] or "").strip("/").split("/") if found else []
    if not found or not all(_PART.fullmatch(part) for part in parts if len(parts) > 1 or part):
        raise CatalogError(f"{text!r} is no bucket, expected s3://BUCKET/PREFIX of plain names")
    return SCHEME + "/".join([found[1], *filter(None, parts)])


class Bucket:
    """The objects below one address."""

    def __init__(self, address: str) -> None:
        self.address = normal_address(address)

    @cached_property
    def _objects(self) -> S3Store:
        name, _, prefix = self.address.removeprefix(SCHEME).partition("/")
        return S3Store(
            name,
            prefix=prefix or None,
            config=_from_files(),
            client_options={"timeout": f"{ANSWER_S} s", "allow_http": _is_plain_http()},
            retry_config={
                "max_retries": RETRIES,
                "retry_timeout": timedelta(seconds=RETRY_S),
                "backoff": {
                    "init_backoff": timedelta(seconds=FIRST_PAUSE_S),
                    "max_backoff": timedelta(seconds=LONGEST_PAUSE_S),
                    "base": 2,
                },
            },
        )

    def where(self, name: str) -> str:
        """The address of an object, for people."""
        return f"{self.address}/{name}"

    def read(self, name: str) -> tuple[bytes, str] | None:
        """Content and version of an object, or None."""
        with self._errors(f"cannot read {self.where(name)}"):
            try:
                found = obstore.get(self._objects, name)
                return bytes(found.bytes()), found.meta["e_tag"] or ""
            except FileNotFoundError:
                return None

    def write(self, name: str, content: bytes, *, replacing: str | None) -> str | None:
        """Write an object of this version, or a new one; its version, or None if it is another."""
        with self._errors(f"cannot write {self.where(name)}"):
            try:
                mode: PutMode = "create" if replacing is None else {"e_tag": replacing}
                return obstore.put(self._objects, name, content, mode=mode)["e_tag"]
            except FileNotFoundError:
                if replacing is None:  # not the object: the bucket
                    raise
                return None
            except (AlreadyExistsError, PreconditionError):
                found = self.read(name)
                return found[1] if found is not None and found[0] == content else None

    def upload(self, name: str, path: Path) -> None:
        """Write a file under a name that nobody else writes."""
        with self._errors(f"cannot write {self.where(name)}"):
            obstore.put(self._objects, name, path, chunk_size=PART_BYTES)

    def download(self, name: str, path: Path) -> str | None:
        """Read an object into a file; the SHA-256 of its bytes, or None if it is not there."""
        digest = hashlib.sha256()
        with self._errors(f"cannot read {self.where(name)}"), path.open("wb") as file:
            try:
                for piece in obstore.get(self._objects, name).stream(min_chunk_size=PART_BYTES):
                    digest.update(piece)
                    file.write(piece)
            except FileNotFoundError:
                return None
        return digest.hexdigest()

    def objects(self, folder: str) -> "Sequence[ObjectMeta]":
        """Every object below a folder: `path`, `size` and `last_modified`.

        Raises:
            StorageError: the bucket is not there.
        """
        with self._errors(f"cannot list {self.where(folder)}"):
            return obstore.list(self._objects, folder).collect()

    def sizes(self, folder: str) -> dict[str, int]:
        """Bytes of every object below a folder, by name; raises what `objects` does."""
        return {one["path"]: one["size"] for one in self.objects(folder)}

    def holds(self, folder: str) -> bool:
        """Whether any object lies below a folder; raises what `objects` does."""
        with self._errors(f"cannot list {self.where(folder)}"):
            return any(obstore.list(self._objects, folder, chunk_size=1))

    def remove(self, names: Iterable[str]) -> None:
        """Remove objects; those that are not there are none."""
        gone = list(names)
        with self._errors(f"cannot delete in {self.address}"):
            if gone:
                obstore.delete(self._objects, gone)

    @contextmanager
    def _errors(self, doing: str) -> Iterator[None]:
        """Turn what is left after all retries into one line."""
        try:
            yield
        except FileNotFoundError:
            raise StorageError(f"{doing}: there is no such bucket") from None
        except (PermissionDeniedError, UnauthenticatedError) as error:
            raise StorageError(f"{doing}: the bucket refuses these credentials") from error
        except BaseError as error:
            if "NoSuchBucket" in str(error):
                raise StorageError(f"{doing}: there is no such bucket") from None
            raise UnreachableError(f"{doing}: {reason_of(error)}") from error


class BucketObjects:
    """Conditional objects in a folder of a bucket; see `leases.ConditionalObjects`.

    A bucket deletes without a condition. What is taken away is therefore overwritten, on the
    condition, by a few bytes that stand for nothing, and stays; the next of that name replaces it.
    """

    def __init__(self, bucket: Bucket, folder: str) -> None:
        self._bucket = bucket
        self._folder = folder

    def read(self, name: str) -> tuple[bytes, str] | None:
        """Content and version of an object, or None."""
        found = self._bucket.read(self._key(name))
        return None if found is None or _is_nothing(len(found[0])) else found

    def write(self, name: str, content: bytes, *, replacing: str | None) -> str | None:
        """Write an object of this version, or a new one; its version, or None if it is another."""
        written = self._bucket.write(self._key(name), content, replacing=replacing)
        if written is not None or replacing is not None:
            return written
        there = self._bucket.read(self._key(name))
        if there is None or not _is_nothing(len(there[0])):
            return None
        return self._bucket.write(self._key(name), content, replacing=there[1])

    def remove(self, name: str, *, version: str) -> bool:
        """Take an object of this version away; whether it was that one."""
        nothing = secrets.token_bytes(_NOTHING_BYTES)
        return self._bucket.write(self._key(name), nothing, replacing=version) is not None

    def names(self) -> list[str]:
        """Names of all objects."""
        found = self._bucket.sizes(self._folder)
        return sorted(
            name.removeprefix(f"{self._folder}/")
            for name, num_bytes in found.items()
            if not _is_nothing(num_bytes)
        )

    def _key(self, name: str) -> str:
        if not _PART.fullmatch(name):
            raise CatalogError(f"{name!r} cannot name an object, expected letters, digits, ._-")
        return f"{self._folder}/{name}"


_NOTHING_BYTES = 12


def _is_nothing(num_bytes: int) -> bool:
    return num_bytes <= _NOTHING_BYTES


def table_options() -> dict[str, str]:
    """What Delta Lake is told, so that it finds the same bucket as `Bucket` and is as patient."""
    return {
        **_from_files(),
        "timeout": f"{ANSWER_S}s",
        "allow_http": str(_is_plain_http()).lower(),
        "max_retries": str(RETRIES),
        "retry_timeout": f"{RETRY_S}s",
    }


def _is_plain_http() -> bool:
    return os.environ.get("AWS_ENDPOINT_URL", "").startswith("http://")


def _from_files() -> Any:  # noqa: ANN401 - a typed dictionary of each of its two readers
    """What Amazon's files say of the chosen profile; nothing where the environment has keys."""
    if "AWS_ACCESS_KEY_ID" in os.environ:
        return {}
    profile, found = os.environ.get("AWS_PROFILE", "default"), configparser.RawConfigParser()
    for variable, place in _AMAZON_FILES.items():
        with suppress(CatalogError):  # there is no home folder, and so no such file
            found.read(expanded(os.environ.get(variable, place)), "utf-8")
    said: dict[str, str] = {}
    for section in (f"profile {profile}", profile):
        if found.has_section(section):
            said |= {name: value for name, value in found.items(section) if name in _KEYS}
    if "region" in said:
        said["aws_region"] = said.pop("region")
    return said
