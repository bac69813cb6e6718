"""Gaussians in the PLY files that every splat viewer reads (Kerbl et al., 2023).

One element `vertex` of float32: x y z, f_dc_0..2, f_rest_* (all of red, then green, then blue),
opacity (its logit), scale_0..2 (logarithms of metres), rot_0..3 (w x y z). Such a file says nothing
of its frame; ours do in comments.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from lidarpainter_models.errors import DataError
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.storage.whole_files import whole_file

MAX_GAUSSIANS = 50_000_000
"""12 GB at degree 3: more than any drive has given."""
MAX_HEADER_LINES = 256
MAX_LINE_BYTES = 1024
REST_COUNTS = (0, 9, 24, 45)
"""How many `f_rest` there are at degrees 0 to 3."""
_NEEDED = (
    *("x", "y", "z", "opacity"),
    *(f"f_dc_{channel}" for channel in range(3)),
    *(f"scale_{axis}" for axis in range(3)),
    *(f"rot_{part}" for part in range(4)),
)
_MAY_BE_ENDLESS = ("opacity", "scale_0")
_ENDLESS = 30.0
"""Stands for infinity: others write it for opacities of 0 and 1, and for scales of 0."""
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_NUMBERS = {
    name: code
    for code, names in (
        ("i1", ("char", "int8")),
        ("u1", ("uchar", "uint8")),
        ("i2", ("short", "int16")),
        ("u2", ("ushort", "uint16")),
        ("i4", ("int", "int32")),
        ("u4", ("uint", "uint32")),
        ("f4", ("float", "float32")),
        ("f8", ("double", "float64")),
    )
    for name in names
}


def write_ply(path: Path, gaussians: GaussianSet, comments: Sequence[str] = ()) -> None:
    """Write Gaussians, all of one frame, aside and renamed whole.

    Raises:
        WriteError: the disk refuses.
    """
    columns = gaussians.columns()
    rest = columns["sh_rest"].transpose(1, 2).flatten(1)  # all of red, then green, then blue
    names = ["x", "y", "z", *(f"f_dc_{channel}" for channel in range(3))]
    names += [f"f_rest_{number}" for number in range(rest.shape[1])]
    names += ["opacity", *(f"scale_{axis}" for axis in range(3))]
    names += [f"rot_{part}" for part in range(4)]
    rows = torch.cat(
        [
            columns["means"],
            columns["sh_dc"].flatten(1),
            rest,
            columns["opacity_logit"][:, None],
            columns["log_scale"],
            torch.nn.functional.normalize(columns["rotation_wxyz"], dim=1),
        ],
        dim=1,
    )
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment {_printable(comment)}" for comment in comments]
    header += [f"element vertex {len(gaussians)}", *(f"property float {name}" for name in names)]
    with whole_file(path) as aside, aside.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        file.write(rows.cpu().numpy().astype("<f4").tobytes())


def read_ply(path: Path) -> GaussianSet:
    """Read Gaussians from a file of anybody, in the frame of the file, as body 0.

    Normals and columns of other programs are passed over. Compressed and text files are refused.

    Raises:
        DataError: it is no such file, is damaged, or holds what no Gaussian can be.
    """
    if not path.is_file():
        raise DataError(f"{path} is not there: expected a .ply file of Gaussians")
    try:
        with path.open("rb") as file:
            count, row = _described(_header(file, path), path)
            start, size = file.tell(), path.stat().st_size
            expected = start + count * row.itemsize
            if size != expected:
                raise DataError(
                    f"{path}: {count} rows of {row.itemsize} bytes need a file of {expected} "
                    f"bytes, it has {size}"
                )
            table = np.fromfile(file, dtype=row, count=count)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    return _gaussians(table, path)


def _header(file: BinaryIO, path: Path) -> list[list[str]]:
    """The words of the lines up to the first row, at which the file then stands."""
    lines: list[list[str]] = []
    while not lines or lines[-1] != ["end_header"]:
        line = file.readline(MAX_LINE_BYTES)
        if not line.endswith(b"\n") or not line.isascii() or len(lines) == MAX_HEADER_LINES:
            raise DataError(f"{path}: no PLY file, its header breaks off, has no end or is no text")
        lines.append(line.decode("ascii").split())
        if lines[0] != ["ply"]:
            raise DataError(f"{path}: no PLY file, expected it to begin with the line 'ply'")
    return lines[1:-1]


def _described(header: list[list[str]], path: Path) -> tuple[int, np.dtype]:
    """How many rows follow the header, and what each of them holds."""
    order, count = None, None
    columns: dict[str, str] = {}
    for words in header:
        match words:
            case ["format", kind, "1.0"] if kind in _ORDERS:
                order = _ORDERS[kind]
            case ["element", "vertex", number] if count is None:
                count = _count(number, path)
            case ["property", kind, name] if kind in _NUMBERS and name not in columns:
                columns[name] = _NUMBERS[kind]
            case [("comment" | "obj_info"), *_] | []:
                pass
            case _:
                raise DataError(
                    f"{path}: cannot use {' '.join(words)[:80]!r} in its header, expected one "
                    "element 'vertex' of plain numbers, binary"
                )
    if order is None or count is None:
        raise DataError(f"{path}: its header lacks a format or an element 'vertex'")
    return count, np.dtype([(name, order + kind) for name, kind in columns.items()])


def _count(number: str, path: Path) -> int:
    if not (number.isascii() and number.isdecimal() and len(number) < 16):
        raise DataError(f"{path}: {number[:40]!r} is no number of rows")
    if int(number) > MAX_GAUSSIANS:
        raise DataError(f"{path}: claims {number} Gaussians, at most {MAX_GAUSSIANS} are read")
    return int(number)


def _gaussians(table: np.ndarray, path: Path) -> GaussianSet:
    names = table.dtype.names or ()
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise DataError(f"{path}: holds no Gaussians, it lacks {', '.join(missing)}")
    num_rest = sum(name.startswith("f_rest_") for name in names)
    rest_names = [f"f_rest_{number}" for number in range(num_rest)]
    if num_rest not in REST_COUNTS or not set(rest_names) <= set(names):
        raise DataError(
            f"{path}: has {num_rest} f_rest, expected f_rest_0 and on, "
            f"{', '.join(map(str, REST_COUNTS))} of them"
        )

    def columns(wanted: Sequence[str]) -> torch.Tensor:
        found = np.empty((len(table), len(wanted)), dtype=np.float32)
        for place, name in enumerate(wanted):
            found[:, place] = table[name]
        if wanted[0] in _MAY_BE_ENDLESS:
            endless = np.isinf(found) & ((found < 0) | (wanted[0] == "opacity"))
            found[endless] = np.copysign(_ENDLESS, found[endless])
        if not np.isfinite(found).all():
            raise DataError(f"{path}: has numbers that are not finite in {wanted[0]} and beside")
        return torch.from_numpy(found)

    rotation_wxyz = columns([f"rot_{part}" for part in range(4)])
    if bool((rotation_wxyz.norm(dim=1) < 1e-6).any()):
        raise DataError(f"{path}: has rotations of length 0, expected quaternions")
    rest = columns(rest_names) if rest_names else torch.zeros(len(table), 0)
    return GaussianSet(
        means=columns(["x", "y", "z"]),
        rotation_wxyz=rotation_wxyz,
        log_scale=columns([f"scale_{axis}" for axis in range(3)]),
        opacity_logit=columns(["opacity"])[:, 0],
        sh_dc=columns([f"f_dc_{channel}" for channel in range(3)])[:, None],
        sh_rest=rest.unflatten(1, (3, num_rest // 3)).transpose(1, 2).contiguous(),
        body_index=torch.zeros(len(table), dtype=torch.int32),
    )


def _printable(comment: str) -> str:
    """A comment that stays one line of ASCII, whatever an actor is called."""
    return comment.encode("unicode_escape").decode("ascii")[: MAX_LINE_BYTES // 2]
