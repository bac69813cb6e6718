"""Who works on what: leases in the store, each with a heartbeat and a fencing number.

A lease is one small object that is there as long as somebody works on what it names. It is made
only if there is none, renewed only by whoever wrote it last, and taken away when the work is over.
One that was not renewed for its time to live, or whose process is gone from this machine, has
expired: the ledger enters what became of the work and takes the lease away (see `fleets`).

The fencing number is higher than any that was written about the same work before. What a process
writes that slept too long and lost its lease bears an old number and is refused there.

Objects are written conditionally, by their version: in a folder under a lock of the kernel; a
bucket has the same as conditional put.
"""

import fcntl
import json
import os
import platform
import re
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Protocol

from catalog.digests import digest_text
from catalog.errors import CatalogError, ConflictError, StorageError, storage_errors

TIME_TO_LIVE_S = 120.0
"""Without a heartbeat; clocks of machines that share a store must agree far better than this."""
BEATS = 12
"""Heartbeats in a time to live."""
POLL_S = 0.2
"""Seconds between two looks at a lease that somebody else holds."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,159}")
_PROC = Path("/proc")
_STARTED, _STATE = 19, 0
"""Fields of /proc/PID/stat after the name of the command (proc(5))."""


class LeaseLostError(ConflictError):
    """The lease is no longer this holder's: it had expired, or was taken away."""


class ConditionalObjects(Protocol):
    """Small named objects that are written only if nobody else has written meanwhile."""

    def read(self, name: str) -> tuple[bytes, str] | None:
        """Content and version of an object, or None."""
        ...

    def write(self, name: str, content: bytes, *, replacing: str | None) -> str | None:
        """Write an object of this version, or a new one; its version, or None if it is another."""
        ...

    def remove(self, name: str, *, version: str) -> bool:
        """Take an object of this version away; whether it was that one."""
        ...

    def names(self) -> list[str]:
        """Names of all objects."""
        ...


class FolderObjects:
    """Conditional objects in a folder of one machine, or of a file system that knows `flock`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def read(self, name: str) -> tuple[bytes, str] | None:
        """Content and version of an object, or None."""
        with storage_errors(f"cannot read {self._folder / name}"):
            try:
                content = self._path(name).read_bytes()
            except FileNotFoundError:
                return None
        return content, _version(content)

    def write(self, name: str, content: bytes, *, replacing: str | None) -> str | None:
        """Write an object of this version, or a new one; its version, or None if it is another."""
        path = self._path(name)
        with self._locked(name):
            found = self.read(name)
            if (found and found[1]) != replacing:
                return None
            aside = path.with_name(f".{name}.{secrets.token_hex(4)}")
            try:
                aside.write_bytes(content)
                aside.replace(path)
            finally:
                aside.unlink(missing_ok=True)
        return _version(content)

    def remove(self, name: str, *, version: str) -> bool:
        """Take an object of this version away; whether it was that one."""
        with self._locked(name):
            found = self.read(name)
            if found is None or found[1] != version:
                return False
            self._path(name).unlink()
        return True

    def names(self) -> list[str]:
        """Names of all objects."""
        if not self._folder.is_dir():
            return []
        return sorted(one.name for one in self._folder.iterdir() if _NAME.fullmatch(one.name))

    def _path(self, name: str) -> Path:
        if not _NAME.fullmatch(name):
            raise CatalogError(f"{name!r} cannot name a lease, expected letters, digits and ._-")
        return self._folder / name

    @contextmanager
    def _locked(self, name: str) -> Iterator[None]:
        """Alone among all writers, for less than a millisecond: waiting needs no polling."""
        with storage_errors(f"cannot write {self._folder / name}"):
            self._folder.mkdir(parents=True, exist_ok=True)
            lock = os.open(self._folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX)
                yield
            finally:
                os.close(lock)


@dataclass(frozen=True, slots=True, kw_only=True)
class Holder:
    """A process on a machine; a number of a process is used again, its start is not."""

    machine: str
    process_id: int
    started: str

    @classmethod
    def current(cls) -> "Holder":
        """This process."""
        process_id = os.getpid()
        found = _stat(process_id)
        return cls(
            machine=_machine(), process_id=process_id, started=found[_STARTED] if found else ""
        )

    @property
    def name(self) -> str:
        """For people: the machine and the process."""
        return f"{self.machine.split('/')[0]}:{self.process_id}"

    @property
    def is_gone(self) -> bool:
        """Whether it is known to have ended: only of processes of this machine."""
        if self.machine != _machine() or not self.started:
            return False
        found = _stat(self.process_id)
        return found is None or found[_STATE] in "ZX" or found[_STARTED] != self.started


@dataclass(frozen=True, slots=True, kw_only=True)
class Lease:
    """One piece of work in somebody's hands."""

    name: str
    fence: int
    """Higher than that of everybody who worked on it before."""
    holder: Holder
    taken_at: float
    beat_at: float
    """Seconds since 1970."""
    facts: dict[str, Any] = field(default_factory=dict)
    """What the holder says of its work."""
    version: str = ""

    def content(self) -> bytes:
        """The lease as it is stored, in JSON."""
        values = {name: value for name, value in asdict(self).items() if name != "version"}
        return json.dumps({**values, "nonce": secrets.token_hex(4)}).encode()


class Leases:
    """The leases of one store."""

    def __init__(
        self,
        objects: ConditionalObjects,
        *,
        time_to_live_s: float = TIME_TO_LIVE_S,
        now: Callable[[], float] = time.time,
    ) -> None:
        self.time_to_live_s = time_to_live_s
        self._objects = objects
        self._now = now
        self._holder = Holder.current()

    def take(self, name: str, *, above: int, facts: dict[str, Any]) -> Lease | None:
        """Begin to work on something, or None if it is in anybody's hands, expired ones too.

        `above` is the highest fencing number that is known of it; others may read the `facts`.
        """
        now = self._now()
        lease = Lease(
            name=name, fence=above + 1, holder=self._holder, taken_at=now, beat_at=now, facts=facts
        )
        version = self._objects.write(name, lease.content(), replacing=None)
        return None if version is None else replace(lease, version=version)

    def renew(self, lease: Lease, facts: dict[str, Any]) -> Lease:
        """Give a sign of life: write the lease anew with the time of now.

        Raises:
            LeaseLostError: the lease is no longer this holder's.
        """
        beaten = replace(lease, beat_at=self._now(), facts={**lease.facts, **facts})
        version = self._objects.write(lease.name, beaten.content(), replacing=lease.version)
        if version is None:
            raise LeaseLostError(f"the lease {lease.name} of number {lease.fence} was taken away")
        return replace(beaten, version=version)

    def give_back(self, lease: Lease) -> bool:
        """Take a lease away, one's own or an expired one; whether it still was as it is given."""
        return self._objects.remove(lease.name, version=lease.version)

    @contextmanager
    def kept(self, name: str) -> Iterator[None]:
        """Hold a lease of a name of one's own while the block runs; a thread renews it."""
        lease = self.take(name, above=0, facts={})
        if lease is None:
            raise LeaseLostError(f"the lease {name} is in other hands")
        with self._beating(lease):
            yield

    @contextmanager
    def alone(self, name: str, *, on_wait: Callable[[str], None] | None = None) -> Iterator[None]:
        """Hold a lease while the block runs; wait for as long as anybody else holds it.

        `on_wait` is told who does, once.
        """
        while (lease := self.take(name, above=0, facts={})) is None:
            found = self._objects.read(name)
            if found is not None and self.has_expired(other := _parsed(name, *found)):
                self.give_back(other)
                continue
            if found is not None and on_wait is not None:
                on_wait(other.holder.name)
                on_wait = None
            time.sleep(POLL_S)
        with self._beating(lease):
            yield

    @contextmanager
    def _beating(self, lease: Lease) -> Iterator[None]:
        """Renew a lease from a thread, and give it back at the end."""
        last, over = [lease], threading.Event()

        def beat() -> None:
            while not over.wait(self.time_to_live_s / BEATS):
                with suppress(StorageError, LeaseLostError):  # the next beat may get through
                    last[0] = self.renew(last[0], {})

        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()
            with suppress(StorageError):  # it will have expired
                self.give_back(last[0])

    def held(self) -> list[Lease]:
        """All leases that are there, expired ones too."""
        found = ((name, self._objects.read(name)) for name in self._objects.names())
        return [_parsed(name, *one) for name, one in found if one is not None]

    def has_expired(self, lease: Lease) -> bool:
        """Whether nobody works under it any more, as far as can be known."""
        return lease.holder.is_gone or self._now() - lease.beat_at > self.time_to_live_s

    def is_near(self, lease: Lease) -> bool:
        """Whether its holder is on this machine."""
        return lease.holder.machine == self._holder.machine


def _parsed(name: str, content: bytes, version: str) -> Lease:
    try:
        values = json.loads(content)
        return Lease(
            name=name,
            fence=int(values["fence"]),
            holder=Holder(**values["holder"]),
            taken_at=float(values["taken_at"]),
            beat_at=float(values["beat_at"]),
            facts=dict(values["facts"]),
            version=version,
        )
    except (ValueError, KeyError, TypeError) as error:
        raise CatalogError(f"the lease {name} is damaged: {error!r}; delete its file") from None


def _version(content: bytes) -> str:
    return digest_text(content.decode("latin-1"))


@cache
def _machine() -> str:
    """This machine since it was started, and which numbers of processes this one sees."""
    boot, space = _PROC / "sys/kernel/random/boot_id", _PROC / "self/ns/pid"
    return "/".join(
        [
            platform.node(),
            boot.read_text("ascii").strip() if boot.exists() else "",
            str(space.readlink()) if space.is_symlink() else "",
        ]
    )


def _stat(process_id: int) -> list[str] | None:
    """What the kernel lists of a process after its command, or None."""
    try:
        text = (_PROC / str(process_id) / "stat").read_text("utf-8", "replace")
    except OSError:
        return None
    return text.rpartition(")")[2].split()
