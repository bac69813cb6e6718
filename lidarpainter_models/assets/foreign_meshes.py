"""Somebody else's meshes, as trimesh reads them: OBJ, PLY and glTF, each part where it stands."""

import json
import struct
from dataclasses import replace
from io import BytesIO

import numpy as np

from lidarpainter_models.assets.foreign_files import UNREADABLE, ForeignFolder, ForeignShape
from lidarpainter_models.errors import DataError

SPLATS = "; Gaussians are imported as PLY or SPZ"
MOST_TRIANGLES = 20_000_000
"""Of all parts, each as often as it is shown."""


def read_meshes(folder: ForeignFolder) -> ForeignShape:
    """All triangles of a file, with what their colours come from.

    Raises:
        DataError: it cannot be read, holds no triangles or too many, or names what is not there or
            not in its folder.
    """
    import trimesh

    ending, parts, count = folder.file.suffix.lower().removeprefix("."), [], 0
    try:
        scene = trimesh.load_scene(BytesIO(folder.content), file_type=ending, resolver=folder)
        for node in scene.graph.nodes_geometry:
            pose, name = scene.graph[node]
            mesh = scene.geometry[name]
            count += len(getattr(mesh, "faces", ()))
            if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) and count <= MOST_TRIANGLES:
                parts.append(mesh.copy().apply_transform(np.asarray(pose, float)))
    except UNREADABLE as error:
        reason = folder.problem or f"{folder.file}: cannot be read as {ending} ({error!r:.200})"
        raise DataError(reason) from None
    if folder.problem:
        raise DataError(folder.problem)
    if not parts or count > MOST_TRIANGLES:
        raise DataError(f"{folder.file}: {count} triangles, expected 1 to {MOST_TRIANGLES}{SPLATS}")
    return ForeignShape(meshes=parts)


def read_gltf(folder: ForeignFolder) -> ForeignShape:
    """Meshes of a glTF file, which is y up, in metres, with colours in linear light.

    Raises:
        DataError: as `read_meshes`, or its triangles are packed by an extension.
    """
    content = folder.content
    try:
        if content.startswith(b"glTF"):
            content = content[20 : 20 + struct.unpack_from("<I", content, 12)[0]]
        columns = json.loads(content)["accessors"]
        are_plain = all("bufferView" in one and "sparse" not in one for one in columns)
    except (*UNREADABLE, struct.error) as error:
        raise DataError(f"{folder.file}: no readable glTF file ({error!r:.200})") from None
    if not are_plain:
        raise DataError(f"{folder.file}: has packed columns, expected plain triangles")
    return replace(read_meshes(folder), up="y", is_linear=True)
