"""Training pairs on disk: one safetensors file per pair, an index beside them.

Images are stored as bytes, depth as float16, masks as bytes; a window is read without reading
the rest of the file. The index names every file with its size, its SHA-256 and where it came from;
it is rewritten whole after every pair, so a harvest that is killed leaves a folder that is valid
and can be continued.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.painter.examples import PaintingPair, Window
from lidarpainter_models.painter.protocol import PaintingConditions
from lidarpainter_models.storage.tensor_files import open_tensors, pack_tensors
from lidarpainter_models.storage.whole_files import write_whole

PAIR_FORMAT = "lidarpainter-pair/1"
INDEX_NAME = "index.json"
LARGEST_DEPTH_M = 60_000.0  # under the largest float16; the sky has depth 0, not infinity


class PairFolder:
    """Pairs that were harvested into a folder; a `PairSource`."""

    def __init__(self, folder: Path) -> None:
        """Open a folder written by `PairWriter`.

        Raises:
            DataError: no index, an index that cannot be read, or a file of it is missing.
        """
        self.folder = folder
        self._pairs = _read_index(folder)
        for entry in self._pairs:
            if entry["file"] != Path(entry["file"]).name or not (folder / entry["file"]).is_file():
                raise DataError(f"pair folder {folder} lacks {entry['file']}, named in its index")

    def __len__(self) -> int:
        return len(self._pairs)

    @property
    def digest(self) -> str:
        """SHA-256 over the digests of all pairs, in order."""
        joined = "\n".join(entry["sha256"] for entry in self._pairs)
        return hashlib.sha256(joined.encode()).hexdigest()

    def size_px(self, index: int) -> tuple[int, int]:
        """Height and width of a pair."""
        entry = self._pairs[index]
        return entry["height_px"], entry["width_px"]

    def name(self, index: int) -> str:
        """Name of a pair, as given to `PairWriter.add`."""
        return Path(self._pairs[index]["file"]).stem

    def provenance(self, index: int) -> dict[str, Any]:
        """Where a pair comes from."""
        return self._pairs[index]["provenance"]

    def describe(self) -> dict[str, Any]:
        """The digest and what every pair came from."""
        pairs = {self.name(index): self.provenance(index) for index in range(len(self))}
        return {"folder": self.folder.name, "digest": self.digest, "pairs": pairs}

    def read(self, index: int, window: Window | None = None) -> PaintingPair:
        """A pair, or the part of it inside a window.

        Raises:
            DataError: the file is damaged.
        """
        return load_pair(self.folder / self._pairs[index]["file"], window)

    def first_without(self, tensor_name: str) -> str | None:
        """Name of the first pair that was stored without an optional tensor; None if all have it.

        Raises:
            DataError: a file is damaged.
        """
        for index, entry in enumerate(self._pairs):
            with open_tensors(self.folder / entry["file"]) as (file, _):
                if tensor_name not in file.keys():  # noqa: SIM118 - the file is no mapping
                    return self.name(index)
        return None

    def verify(self) -> None:
        """Check every byte against the index.

        Raises:
            DataError: a file has changed since it was written.
        """
        for entry in self._pairs:
            found = hashlib.sha256((self.folder / entry["file"]).read_bytes()).hexdigest()
            if found != entry["sha256"]:
                raise DataError(
                    f"pair {self.folder / entry['file']} has SHA-256 {found[:12]}..., "
                    f"expected {entry['sha256'][:12]}..."
                )


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


class PairWriter:
    """Adds pairs to a folder, which is created if need be."""

    def __init__(self, folder: Path) -> None:
        """Start a folder or continue one.

        Raises:
            DataError: the folder holds an index that cannot be read.
        """
        self.folder = folder
        self._pairs = _read_index(folder) if (folder / INDEX_NAME).exists() else []

    def __contains__(self, name: str) -> bool:
        """Whether a pair of this name is already there."""
        return any(entry["file"] == f"{name}.safetensors" for entry in self._pairs)

    def add(self, name: str, pair: PaintingPair, provenance: dict[str, Any]) -> Path:
        """Write a pair and index it.

        Raises:
            DataError: the name cannot be a file name or is taken.
            WriteError: the disk refuses.
        """
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._+-]*", name) or name in self:
            raise DataError(f"pair name {name!r} is taken or not letters, digits and ._+-")
        content = _encode(pair, provenance)
        height_px, width_px = pair.conditions.height_width_px
        file_name = f"{name}.safetensors"
        entry = {
            "file": file_name,
            "height_px": height_px,
            "width_px": width_px,
            "sha256": hashlib.sha256(content).hexdigest(),
            "provenance": provenance,
        }
        path = self.folder / file_name
        write_whole(path, content)
        index = {"format": PAIR_FORMAT, "pairs": [*self._pairs, entry]}
        write_whole(self.folder / INDEX_NAME, json.dumps(index, indent=1).encode())
        self._pairs.append(entry)
        return path


def load_pair(path: Path, window: Window | None = None) -> PaintingPair:
    """Read a pair file, whole or the part inside a window.

    Raises:
        DataError: the file is missing, damaged or not a pair.
    """
    with open_tensors(path) as (file, header):
        if header.get("format") != PAIR_FORMAT:
            raise DataError(f"{path} has format {header.get('format')!r}, expected {PAIR_FORMAT!r}")
        names = _KINDS.keys() - (_OPTIONAL - set(file.keys()))
        stored = {name: _cut(file.get_slice(name), name, window) for name in names}
    values = {name: _decode(stored[name], _KINDS[name]) for name in stored}
    target_rgb, target_valid = values.pop("target_rgb"), values.pop("target_valid")
    conditions = PaintingConditions(**values, prompt=header["prompt"])
    return PaintingPair(conditions=conditions, target_rgb=target_rgb, target_valid=target_valid)


_KINDS = {
    "render_rgb": "byte",
    "render_depth_m": "depth",
    "render_alpha": "byte",
    "lidar_rgb": "byte",
    "lidar_depth_m": "depth",
    "lidar_hit": "mask",
    "warp_rgb": "byte",
    "warp_valid": "mask",
    "target_rgb": "byte",
    "target_valid": "mask",
    "reference_rgb": "byte",
}
_OPTIONAL = {"reference_rgb"}
"""Not in pairs that were harvested before it was gathered."""


def _encode(pair: PaintingPair, provenance: dict[str, Any]) -> bytes:
    tensors: dict[str, Tensor] = {}
    for name, kind in _KINDS.items():
        owner = pair if name.startswith("target") else pair.conditions
        value = getattr(owner, name)
        if value is None:
            continue
        value = value.detach().cpu()
        if kind == "byte":
            value = (value.clamp(0, 1) * 255).round().to(torch.uint8)
        elif kind == "depth":
            value = value.clamp(0, LARGEST_DEPTH_M).to(torch.float16)
        tensors[name] = value.to(torch.uint8 if kind == "mask" else value.dtype).contiguous()
    header = {"format": PAIR_FORMAT, "prompt": pair.conditions.prompt, "provenance": provenance}
    return pack_tensors(tensors, header)


def _decode(stored: Tensor, kind: str) -> Tensor:
    if kind == "mask":
        return stored > 0
    return stored.float() / 255 if kind == "byte" else stored.float()


def _cut(stored: Any, name: str, window: Window | None) -> Tensor:  # noqa: ANN401 - safetensors'
    if window is None:
        return stored[:]
    rows, columns = window.slices
    return stored[:, rows, columns] if name.startswith("warp") else stored[rows, columns]


def _read_index(folder: Path) -> list[dict[str, Any]]:
    path = folder / INDEX_NAME
    try:
        index = json.loads(path.read_text("utf-8"))
        pairs = [
            {key: entry[key] for key in ("file", "height_px", "width_px", "sha256", "provenance")}
            for entry in index["pairs"]
        ]
    except FileNotFoundError:
        raise DataError(f"no training pairs in {folder}: expected {INDEX_NAME}") from None
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise DataError(f"{path} is not a readable index of pairs: {error!r}") from None
    if index.get("format") != PAIR_FORMAT:
        raise DataError(f"{path} has format {index.get('format')!r}, expected {PAIR_FORMAT!r}")
    return pairs
