"""Somebody else's meshes, as trimesh reads them: OBJ, PLY and glTF, each part where it stands."""

import json
import struct
from collections.abc import Iterable, Sequence
from dataclasses import replace
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from lidarpainter_models.assets.foreign_files import UNREADABLE, ForeignFolder, ForeignShape
from lidarpainter_models.assets.foreign_images import load_images, opened_image
from lidarpainter_models.errors import DataError

if TYPE_CHECKING:
    from trimesh import Trimesh

SPLATS = "; Gaussians are imported as PLY or SPZ"
"""Ends the message about a file without triangles, which may be meant to hold Gaussians."""
IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".tga", ".bmp", ".dds", ".ktx2", ".tif", ".tiff")
"""How the names of textures end; whatever else is read beside a mesh is no image."""
TRIANGLES = 4
"""How a primitive of glTF says that it is drawn as triangles."""
MOST_TRIANGLES = 5_000_000
"""Limit on the triangles of all parts, each counted as often as it is shown."""


def read_meshes(folder: ForeignFolder, *, num_textures: int | None = None) -> ForeignShape:
    """All triangles of a file, with what their colours come from.

    `num_textures` different ones must have come through. Where nobody knows their number, every
    image that was read must be one, and be of use.

    Raises:
        DataError: it cannot be read, holds no triangles or too many, has lost a texture, or
            names what is not there or not in its folder.
    """
    import trimesh

    asked: Any = folder  # trimesh needs no more of a resolver
    ending, parts, count = folder.file.suffix.lower().removeprefix("."), [], 0
    try:
        content = BytesIO(folder.content)
        # processing would drop vertices that are no numbers
        scene = trimesh.load_scene(content, file_type=ending, resolver=asked, process=False)
        images = _shared_images(scene.geometry.values())
        for node in scene.graph.nodes_geometry:
            pose, name = scene.graph[node]
            mesh = scene.geometry[name]
            count += len(getattr(mesh, "faces", ()))
            if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) and count <= MOST_TRIANGLES:
                parts.append(moved_part(mesh, np.asarray(pose, float)))
    except UNREADABLE as error:
        reason = folder.problem or f"{folder.file}: cannot be read as {ending} ({error!r:.200})"
        raise DataError(reason) from None
    if folder.problem:
        raise DataError(folder.problem)
    if not parts or count > MOST_TRIANGLES:
        raise DataError(f"{folder.file}: {count} triangles, expected 1 to {MOST_TRIANGLES}{SPLATS}")
    _check_textures(folder, images, num_textures)
    return ForeignShape(meshes=parts)


def moved_part(mesh: "Trimesh", pose: Float[np.ndarray, "4 4"]) -> "Trimesh":
    """A mesh where a pose puts it, of which all that is read later could be read.

    It shares colours and images with the mesh that it was: a texture is large.

    Raises:
        ValueError: vertices or places on its texture are missing, or have too few numbers.
        Exception: any of `UNREADABLE`: a triangle has a corner that is not there.
    """
    import trimesh

    uv = getattr(mesh.visual, "uv", None)
    uv = np.zeros((len(mesh.vertices), 2)) if uv is None else uv
    if mesh.triangles.shape[1:] != (3, 3) or len(uv) != len(mesh.vertices) or uv.shape[1] < 2:
        raise ValueError("vertices, or their places on a texture, of too few numbers")
    vertices = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
    return trimesh.Trimesh(vertices, mesh.faces, visual=mesh.visual, process=False)


def _shared_images(meshes: Iterable[Any]) -> list[Any]:
    """The different images of meshes; an .mtl may name one file in many materials."""
    by_path: dict[Any, Any] = {}
    images: dict[int, Any] = {}
    for mesh in meshes:
        material: Any = getattr(getattr(mesh, "visual", None), "material", None)
        if getattr(material, "image", None) is not None:
            path = material.image.info.get("file_path", id(material.image))
            material.image = by_path.setdefault(path, material.image)
        for name in ("image", "baseColorTexture"):
            image = getattr(material, name, None)
            if image is not None:
                images[id(image)] = image
    return list(images.values())


def _check_textures(folder: ForeignFolder, images: Sequence[Any], expected: int | None) -> None:
    """Decode all textures; refuse a file of which trimesh has passed over one."""
    if expected is None:
        files = [one for one in folder.digests if one.suffix.lower() in IMAGES]
        for one in files:
            opened_image(folder.file, one.read_bytes())
        expected = min(1, len(files))
    if len(images) < expected:
        said = f"{len(images)} of {expected}, expected PNG or JPEG"
        raise DataError(f"{folder.file}: its textures cannot be read ({said})")
    load_images(folder.file, images)


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
        columns, num_textures = document["accessors"], _num_textures(document)
        are_plain = all("bufferView" in one and "sparse" not in one for one in columns)
    except (*UNREADABLE, struct.error) as error:
        raise DataError(f"{folder.file}: no readable glTF file ({error!r:.200})") from None
    if not are_plain:
        raise DataError(f"{folder.file}: has packed columns, expected plain triangles")
    return replace(read_meshes(folder, num_textures=num_textures), up="y", is_linear=True)


def _num_textures(document: dict[str, Any]) -> int:
    """How many different images the colours of a glTF file's triangles come from."""
    materials, textures = document.get("materials", ()), document.get("textures", ())
    primitives = [one for mesh in document.get("meshes", ()) for one in mesh["primitives"]]
    used = {
        one["material"]
        for one in primitives
        if "material" in one and one.get("mode", TRIANGLES) == TRIANGLES
    }
    images = set()
    for number in used:
        colour = materials[number].get("pbrMetallicRoughness", {}).get("baseColorTexture")
        if colour is not None:
            index = colour["index"]
            texture = textures[index] if index < len(textures) else {}
            # an extension may name another image, of another kind
            is_plain = "source" in texture and "extensions" not in texture
            images.add(("image", texture["source"]) if is_plain else ("texture", index))
    return len(images)
