"""Somebody else's meshes, as trimesh reads them: OBJ, PLY and glTF, each part where it stands."""

import json
import struct
from dataclasses import replace
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarpainter_models.assets.foreign_files import UNREADABLE, ForeignFolder, ForeignShape
from lidarpainter_models.errors import DataError

if TYPE_CHECKING:
    from trimesh import Trimesh

SPLATS = "; Gaussians are imported as PLY or SPZ"
IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".tga", ".bmp", ".dds", ".ktx2")
MOST_TRIANGLES = 5_000_000
"""Of all parts, each as often as it is shown."""


def read_meshes(folder: ForeignFolder, *, is_textured: bool = False) -> ForeignShape:
    """All triangles of a file, with what their colours come from.

    Where the file `is_textured`, or has read an image, one must have come through.

    Raises:
        DataError: it cannot be read, holds no triangles or too many, has lost its textures, or
            names what is not there or not in its folder.
    """
    import trimesh

    asked: Any = folder  # trimesh needs no more of a resolver
    ending, parts, count = folder.file.suffix.lower().removeprefix("."), [], 0
    try:
        content = BytesIO(folder.content)
        # processing would drop vertices that are no numbers
        scene = trimesh.load_scene(content, file_type=ending, resolver=asked, process=False)
        for node in scene.graph.nodes_geometry:
            pose, name = scene.graph[node]
            mesh = scene.geometry[name]
            count += len(getattr(mesh, "faces", ()))
            if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) and count <= MOST_TRIANGLES:
                parts.append(checked_part(mesh).apply_transform(np.asarray(pose, float)))
    except UNREADABLE as error:
        reason = folder.problem or f"{folder.file}: cannot be read as {ending} ({error!r:.200})"
        raise DataError(reason) from None
    if folder.problem:
        raise DataError(folder.problem)
    if not parts or count > MOST_TRIANGLES:
        raise DataError(f"{folder.file}: {count} triangles, expected 1 to {MOST_TRIANGLES}{SPLATS}")
    # trimesh passes over images that it cannot read
    if is_textured or any(one.suffix.lower() in IMAGES for one in folder.digests):
        materials = [getattr(mesh.visual, "material", None) for mesh in parts]
        colours = ("image", "baseColorTexture")
        if not any(getattr(one, name, None) for one in materials for name in colours):
            raise DataError(f"{folder.file}: its textures cannot be read, expected PNG or JPEG")
    return ForeignShape(meshes=parts)


def checked_part(mesh: "Trimesh") -> "Trimesh":
    """A copy, of which all that is read later could be read.

    Raises:
        ValueError: vertices or places on its texture lack, or lack numbers.
        Exception: any of `UNREADABLE`: a corner that is not there, an image that breaks off.
    """
    own = mesh.copy()  # with its images
    uv = getattr(own.visual, "uv", None)
    uv = np.zeros((len(own.vertices), 2)) if uv is None else uv
    if own.triangles.shape[1:] != (3, 3) or len(uv) != len(own.vertices) or uv.shape[1] < 2:
        raise ValueError("vertices, or their places on a texture, of too few numbers")
    return own


def read_gltf(folder: ForeignFolder) -> ForeignShape:
    """Meshes of a glTF file, which is y up, in metres, with colours in linear light.

    Raises:
        DataError: as `read_meshes`, or its triangles are packed by an extension.
    """
    content = folder.content
    try:
        if content.startswith(b"glTF"):
            content = content[20 : 20 + struct.unpack_from("<I", content, 12)[0]]
        document = json.loads(content)
        columns, materials = document["accessors"], document.get("materials", ())
        colours = [one.get("pbrMetallicRoughness", {}) for one in materials]
        are_plain = all("bufferView" in one and "sparse" not in one for one in columns)
    except (*UNREADABLE, struct.error) as error:
        raise DataError(f"{folder.file}: no readable glTF file ({error!r:.200})") from None
    if not are_plain:
        raise DataError(f"{folder.file}: has packed columns, expected plain triangles")
    is_textured = any("baseColorTexture" in one for one in colours)
    return replace(read_meshes(folder, is_textured=is_textured), up="y", is_linear=True)
