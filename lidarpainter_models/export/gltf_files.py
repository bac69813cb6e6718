"""A scene as one binary glTF file with `KHR_gaussian_splatting`, its actors as animated nodes.

glTF is y up, z forward, x left: the root node turns the world so, everything below it stands as in
the scene. An actor's node carries its pose at every time; where the actor is absent, its scale is
0, which glTF 2.0 names as the way to animate visibility. Readers that know no splats show points.
"""

import json
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch

from lidarpainter_models.errors import DataError
from lidarpainter_models.export.contents import SceneContents
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.geometry.transforms import quaternion_from_rotation
from lidarpainter_models.storage.whole_files import whole_file

EXTENSION = "KHR_gaussian_splatting"
GLTF_FROM_WORLD_XYZW = (-0.5, -0.5, -0.5, 0.5)
"""x, y, z of glTF are left, up and forward: a third of a turn about the diagonal."""
MAX_BYTES = 2**32 - 1
"""The header of a .glb counts in 32 bits."""
_FLOAT, _BYTE, _POINTS = 5126, 5121, 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


class _Buffer:
    """The binary part of the file, and the accessors that find their way in it."""

    def __init__(self) -> None:
        self.parts: list[np.ndarray] = []
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.num_bytes = 0

    def add(self, values: np.ndarray, *, with_bounds: bool = False) -> int:
        """Append a column, float32 or bytes that stand for 0 to 1; its accessor's number."""
        is_float = values.dtype != np.uint8
        table = np.ascontiguousarray(values, dtype="<f4" if is_float else np.uint8)
        self.views.append({"buffer": 0, "byteOffset": self.num_bytes, "byteLength": table.nbytes})
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": _FLOAT if is_float else _BYTE,
            "count": len(table),
            "type": _TYPES[table.shape[1] if table.ndim == 2 else 1],
        }
        if not is_float:
            accessor["normalized"] = True
        if with_bounds:
            columns = table.reshape(len(table), -1)
            accessor |= {"min": columns.min(0).tolist(), "max": columns.max(0).tolist()}
        self.accessors.append(accessor)
        self.parts.append(table)
        self.num_bytes += table.nbytes  # every column is a multiple of four bytes long
        return len(self.accessors) - 1


def write_gltf(path: Path, contents: SceneContents, *, time: int = 0) -> None:
    """Write a scene and how it moves, aside and renamed whole.

    `time` is which of its times readers show that play no animation.

    Raises:
        DataError: the scene is larger than such a file can be.
        WriteError: the disk refuses.
    """
    buffer = _Buffer()
    meshes: list[dict[str, Any]] = []
    nodes: list[dict[str, Any]] = [{"name": contents.name, "rotation": GLTF_FROM_WORLD_XYZW}]
    parts: list[tuple[str, GaussianSet, dict[str, str]]] = [("street", contents.street, {})]
    parts += [
        (actor.actor_id, actor.gaussians, {"category": actor.category}) for actor in contents.actors
    ]
    for name, gaussians, extras in parts:
        node: dict[str, Any] = {"name": name, **({"extras": extras} if extras else {})}
        if len(gaussians):  # no accessor may be empty
            node["mesh"] = len(meshes)
            meshes.append(_mesh(buffer, name, gaussians))
        nodes.append(node)
    nodes[0]["children"] = list(range(1, len(nodes)))
    animations = _animations(buffer, contents, nodes, time) if contents.actors else []
    document = {
        "asset": {
            "version": "2.0",
            "generator": "lidarpainter",
            "extras": {"time_s": float(contents.seconds[time]), "colours": "without exposure"},
        },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": meshes,
        **({"animations": animations} if animations else {}),
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": buffer.num_bytes}],
    }
    with whole_file(path) as aside, aside.open("wb") as file:
        _write_chunks(file, document, buffer, path)


def _mesh(buffer: _Buffer, name: str, gaussians: GaussianSet) -> dict[str, Any]:
    """Gaussians as points whose attributes carry the prefix of the extension."""
    columns = gaussians.columns()
    rotation = torch.nn.functional.normalize(columns["rotation_wxyz"], dim=1).roll(-1, 1)
    fallback = torch.cat([gaussians.base_rgb, gaussians.opacity[:, None]], dim=1)
    fallback_u8 = (fallback.detach().clamp(0, 1) * 255).round().to(torch.uint8)
    attributes = {
        "POSITION": buffer.add(columns["means"].numpy(), with_bounds=True),
        "COLOR_0": buffer.add(fallback_u8.numpy()),
        f"{EXTENSION}:ROTATION": buffer.add(rotation.numpy()),
        f"{EXTENSION}:SCALE": buffer.add(gaussians.scale_m.detach().numpy()),
        f"{EXTENSION}:OPACITY": buffer.add(gaussians.opacity.detach().numpy()),
    }
    harmonics, first = gaussians.sh.detach().numpy(), 0
    for degree in range(gaussians.sh_degree + 1):
        for order in range(2 * degree + 1):
            column = buffer.add(harmonics[:, first + order])
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = column
        first += 2 * degree + 1
    splats = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: splats}}
    return {"name": name, "primitives": [primitive]}


def _animations(
    buffer: _Buffer, contents: SceneContents, nodes: list[dict[str, Any]], time: int
) -> list[dict[str, Any]]:
    """Pose and presence of every actor over time; its node shows those of one time."""
    poses = contents.world_from_actor
    rotations = quaternion_from_rotation(poses[..., :3, :3])
    # neighbours on the same half of the sphere, so that every reader turns the short way
    turns_over = (rotations[1:] * rotations[:-1]).sum(-1, keepdim=True) < 0
    signs = torch.where(turns_over, -1.0, 1.0).double().cumprod(0)
    rotations = torch.cat([rotations[:1], rotations[1:] * signs]).roll(-1, -1)
    scales = contents.is_present[..., None].expand(-1, -1, 3).float()
    seconds = buffer.add(contents.seconds.numpy(), with_bounds=True)
    samplers, channels = [], []
    for index in range(len(contents.actors)):
        node = index + 2  # after the root and the street
        for way, values, kind in (
            ("translation", poses[:, index, :3, 3], "LINEAR"),
            ("rotation", rotations[:, index], "LINEAR"),
            ("scale", scales[:, index], "STEP"),
        ):
            nodes[node][way] = values[time].tolist()
            output = buffer.add(values.numpy())
            samplers.append({"input": seconds, "output": output, "interpolation": kind})
            target = {"node": node, "path": way}
            channels.append({"sampler": len(samplers) - 1, "target": target})
    return [{"name": "drive", "samplers": samplers, "channels": channels}]


def _write_chunks(file: BinaryIO, document: dict[str, Any], buffer: _Buffer, path: Path) -> None:
    words = json.dumps(document, separators=(",", ":"), allow_nan=False).encode("utf-8")
    words += b" " * (-len(words) % 4)
    total = 12 + 8 + len(words) + 8 + buffer.num_bytes
    if total > MAX_BYTES:
        raise DataError(f"{path}: needs {total / 1e9:.1f} GB, a .glb holds at most 4.3 GB")
    file.write(struct.pack("<4sII", b"glTF", 2, total))
    file.write(struct.pack("<I4s", len(words), b"JSON") + words)
    file.write(struct.pack("<I4s", buffer.num_bytes, b"BIN\0"))
    for part in buffer.parts:
        file.write(part.tobytes())
