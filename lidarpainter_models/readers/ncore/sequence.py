"""A sequence of NCore V4: its component stores, where its frames stand, and what JSON in it says.

`<root>/NAME.ncore4*.zarr.itar` or `<root>/NAME.ncore4*.zarr`, or the same one folder below, are the
stores of the sequence NAME; components (poses, intrinsics, cameras, lidars, cuboids) lie in any of
them. Times are whole microseconds. A pose from a frame to another one takes points of the first to
the second; `rig` is the car, `world` what it drives in.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float64, Int64

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.transforms import is_rigid
from lidarpainter_models.readers.bags.frame_tree import FrameTree
from lidarpainter_models.readers.bags.messages import BagTransform
from lidarpainter_models.readers.ncore.stores import ComponentStore, Shape, fits
from lidarpainter_models.scenes.validation import require_name

RIG, WORLD = "rig", "world"
NS_PER_US = 1000
MAX_POSES = 200_000
"""Of all frames together; a car is asked a hundred times a second where it is."""
_STORE = re.compile(r"(.+?)\.ncore4(-.+)?\.zarr(\.itar)?")
_FRAMES = re.compile(r"\('([^'\\]+)', '([^'\\]+)'\)")
_KINDS = ("poses", "intrinsics", "cameras", "lidars", "cuboids")
_OF_ALL = ("version", "sequence_id", "generic_meta_data")
"""What all stores of a sequence say alike."""
_MAX_WHOLE = 2**52
Value = TypeVar("Value")


def list_ncore_sequences(root: Path) -> tuple[str, ...]:
    """Names of the sequences at a root or one folder below it, sorted."""
    return tuple(sorted({name for name, _ in _found_stores(root)}))


def _found_stores(root: Path) -> Iterator[tuple[str, Path]]:
    for pattern in ("", "*/"):
        for path in root.glob(f"{pattern}*.ncore4*.zarr*"):
            if match := _STORE.fullmatch(path.name):
                yield match[1], path


@dataclass(frozen=True, slots=True)
class Component:
    """A component of a sequence, such as a camera."""

    store: ComponentStore
    path: str

    def place(self, name: str = "") -> str:
        """Where something of it lies, to name in errors."""
        return f"{self.store.root}/{self._path(name)}"

    def attributes(self, name: str = "") -> dict[str, Any]:
        """The attributes of a group of it."""
        return self.store.attributes(self._path(name))

    def has(self, name: str) -> bool:
        """Whether it has such an array."""
        return any(self.store.has(f"{self._path(name)}/{one}") for one in (".zarray", "zarr.json"))

    def array(self, name: str, *shape: int | None) -> np.ndarray:
        """An array of it, of the shape that is stated; None stands for any length."""
        return self.store.array(self._path(name), shape)

    def bytes(self, name: str) -> bytes:
        """The bytes of an array of it, whatever its shape."""
        return self.store.array(self._path(name)).tobytes()

    def frames_us(self) -> Int64[np.ndarray, "frames 2"]:
        """Start and end of each frame of a sensor, both ascending; their ends are their names."""
        where = self.place("frames")
        stated = entry(self.attributes("frames"), "frames_timestamps_us", list, where)
        frames_us = whole_numbers(stated or np.zeros((0, 2)), (None, 2), where)
        if (frames_us[:, 0] > frames_us[:, 1]).any() or (np.diff(frames_us, axis=0) <= 0).any():
            raise DataError(f"{where}: the times of the frames do not ascend")
        return frames_us

    def _path(self, name: str) -> str:
        return f"{self.path}/{name}" if name else self.path


class NcoreSequence:
    """The stores of a sequence, opened."""

    def __init__(self, root: Path, name: str) -> None:
        """Open the stores and find their components.

        Raises:
            DataError: there are none, or they are damaged, or not of one sequence.
        """
        paths = sorted(path for found, path in _found_stores(root) if found == name)
        if len({path.parent for path in paths}) != 1:
            where = "in several folders" if paths else "nowhere"
            expected = f"expected {name}.ncore4*.zarr.itar in one folder"
            raise DataError(f"{root}: {name} lies {where}, {expected}")
        self.place = f"{paths[0].parent}/{name}"
        self._stores = [ComponentStore(path) for path in paths]
        heads = [store.attributes("") for store in self._stores]
        for store, head in zip(self._stores, heads, strict=True):
            told = [head.get(name) for name in _OF_ALL]
            if told != ["v4", *(heads[0].get(name) for name in _OF_ALL[1:])]:
                raise DataError(f"{store.root}: {told!r:.80}, expected v4 and one sequence")
        self.told = entry(heads[0], "generic_meta_data", dict, self.place)
        """What its writer says of it, in words of his own."""
        self._components: dict[str, dict[str, Component]] = {kind: {} for kind in _KINDS}
        for store, kind in product(self._stores, _KINDS):
            for one in store.children(kind):
                component = Component(store, f"{kind}/{one}")
                version = component.attributes().get("component_version")
                if version != "v1" or one in self._components[kind]:
                    what = f"version {version!r:.20}, expected v1, and each component once"
                    raise DataError(f"{component.place()}: {what}")
                self._components[kind][one] = component
        self.tree = FrameTree(_transforms(self.one("poses")), self.place)

    def of_kind(self, kind: str) -> dict[str, Component]:
        """The components of a kind by name, sorted; refuses names that no sensor can have."""
        found = sorted(self._components[kind].items())
        return {require_name(name, f"{self.place}: {kind}"): one for name, one in found}

    def one(self, kind: str) -> Component:
        """The component of a kind of which there is one; of several the `default` one.

        Raises:
            DataError: there is none, or nothing says which.
        """
        found = self._components[kind]
        if len(found) != 1 and "default" not in found:
            what = f"{len(found)} components {kind}, expected one, or one called default"
            raise DataError(f"{self.place}: {what}")
        return found.get("default") or next(iter(found.values()))

    def provenance(self) -> dict[str, object]:
        """What was read of which store."""
        return {store.root.name: store.provenance()["sha256"] for store in self._stores}


def _transforms(poses: Component) -> Iterator[BagTransform]:
    """All poses, each from the frame that stands in the other one."""
    kinds: tuple[tuple[str, str, Shape], ...] = (
        ("static_poses", "pose", (4, 4)),
        ("dynamic_poses", "poses", (None, 4, 4)),
    )
    for kind, name, shape in kinds:
        for key, record in poses.attributes(kind).items():
            where = f"{poses.place(kind)}, {key!r:.80}"
            match = _FRAMES.fullmatch(key)
            if match is None:
                raise DataError(f"{where}: expected poses between two named frames")
            found = numbers(entry(record, name, list, where), shape, where).reshape(-1, 4, 4)
            times_us = [0] if kind == "static_poses" else record.get("timestamps_us")
            times_us = whole_numbers(times_us, (len(found),), where).tolist()
            stacked = torch.from_numpy(found)
            if not bool(is_rigid(stacked).all()) or not 0 < len(found) <= MAX_POSES:
                raise DataError(f"{where}: expected 1 to {MAX_POSES} rigid transforms")
            for time_us, pose in zip(times_us, stacked, strict=True):
                yield BagTransform(
                    parent=match[2],
                    child=match[1],
                    time_ns=time_us * NS_PER_US,
                    parent_from_child=pose,
                )


def entry(stated: object, name: str, kind: type[Value], where: str) -> Value:
    """An entry of a JSON object, of the kind that it must have.

    Raises:
        DataError: it is absent or something else.
    """
    value = stated.get(name) if isinstance(stated, dict) else None
    if not isinstance(value, kind):
        raise DataError(f"{where}: {name} is {value!r:.60}, expected a JSON {kind.__name__}")
    return value


def numbers(stated: object, shape: Shape, where: str) -> Float64[np.ndarray, "*values"]:
    """Finite numbers of some shape that JSON states.

    Raises:
        DataError: they are something else.
    """
    try:
        found = np.array(stated)
    except (ValueError, OverflowError):
        found = np.array(None)
    if (
        found.dtype.kind not in "iuf"
        or not fits(found.shape, shape)
        or not np.isfinite(found).all()
    ):
        raise DataError(f"{where}: expected finite numbers, as many as {shape}")
    return found.astype(np.float64)


def whole_numbers(stated: object, shape: Shape, where: str) -> Int64[np.ndarray, "*values"]:
    """Whole numbers from 0 up that JSON states; 53 bits of microseconds are three centuries.

    Raises:
        DataError: they are something else.
    """
    found = numbers(stated, shape, where)
    if not ((found >= 0) & (found < _MAX_WHOLE) & (found % 1 == 0)).all():
        raise DataError(f"{where}: expected whole numbers from 0 to {_MAX_WHOLE}")
    return found.astype(np.int64)
