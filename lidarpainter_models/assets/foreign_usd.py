"""Somebody else's OpenUSD: meshes with their materials, SimReady's among them.

Before anything is taken from a stage, all that it and its layers name is looked up: it must lie in
the folder of the file, or in its package. Of materials the colour is taken: UsdPreviewSurface's, or
that of NVIDIA's OmniPBR. Needs usd-core (extra `export`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from lidarpainter_models.assets.foreign_files import UNREADABLE, ForeignFolder, ForeignShape
from lidarpainter_models.assets.foreign_images import load_images, opened_image
from lidarpainter_models.assets.foreign_meshes import MOST_TRIANGLES, SPLATS, moved_part
from lidarpainter_models.errors import DataError, MissingPackageError

COLOURS = ("diffuseColor", "diffuse_texture", "diffuse_color_constant")
"""Inputs of shaders that say a colour or name its texture; the first that does is taken."""
TINT = "diffuse_tint"
"""What OmniPBR multiplies a texture by; its plain colour does not count beside a texture."""
CODE = ".mdl"
"""NVIDIA's materials name their code by a file that ends so. It comes with NVIDIA's programs and
need not lie beside a stage; nothing reads it here."""


def read_usd(folder: ForeignFolder) -> ForeignShape:
    """What a stage shows at its first moment.

    Raises:
        DataError: it cannot be opened, shows no mesh, or names what is not in its folder.
        MissingPackageError: the extra `export` is not installed.
    """
    try:
        from pxr import Tf, Usd, UsdGeom, UsdUtils
    except ImportError:
        hint = "USD needs usd-core: pip install 'lidarpainter[export]'"
        raise MissingPackageError(hint) from None
    said = UsdUtils.CoalescingDiagnosticDelegate()  # in place of stderr
    try:
        _look_up(folder)
        stage = Usd.Stage.Open(str(folder.file))
        meshes = list(_Stage(stage, folder, Usd.TimeCode.EarliestTime()).parts())
    except DataError:
        raise
    except (*UNREADABLE, Tf.ErrorException):  # what USD says need not be text
        raise DataError(folder.problem or f"{folder.file}: no readable USD file") from None
    finally:
        said.TakeUncoalescedDiagnostics()
    if not meshes:
        raise DataError(f"{folder.file}: shows no mesh{SPLATS}")
    return ForeignShape(
        meshes=meshes,
        up="z" if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else "y",
        unit_m=float(UsdGeom.GetStageMetersPerUnit(stage)),
        is_linear=True,
    )


def _look_up(folder: ForeignFolder) -> None:
    """Read all that a file is made of, so that it is known and nothing lies elsewhere."""
    from pxr import UsdUtils

    layers, assets, missing = UsdUtils.ComputeAllDependencies(str(folder.file))
    places = [*(layer.realPath for layer in layers), *assets, *missing]
    for place in places:
        if not place.endswith(CODE) and not place.startswith(f"{folder.file}["):
            folder.get(place)


@dataclass(frozen=True, eq=False)
class _Stage:
    """An opened stage at one moment; objects of pxr have no types."""

    stage: Any
    folder: ForeignFolder
    time: Any
    images: dict[str, Any] = field(default_factory=dict)
    """Textures that were decoded, by place."""

    def parts(self) -> Iterator[Any]:
        """Meshes that are drawn, as triangles in the frame of the stage, apart by material."""
        from pxr import Usd, UsdGeom

        poses, count = UsdGeom.XformCache(self.time), 0
        for prim in Usd.PrimRange(self.stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
            if prim.IsA(UsdGeom.PointInstancer):
                said = f"{self.folder.file}: {prim.GetPath()} is a point instancer"
                raise DataError(f"{said}, expected meshes that stand in the stage themselves")
            pose, most = np.array(poses.GetLocalToWorldTransform(prim)).T, MOST_TRIANGLES - count
            for part in self._of(UsdGeom.Mesh(prim), most) if self._is_drawn(prim) else ():
                count += len(part.faces)
                yield moved_part(part, pose)
            count += 1
            if count > MOST_TRIANGLES:
                raise DataError(f"{self.folder.file}: more than {MOST_TRIANGLES} triangles")

    def _is_drawn(self, prim: Any) -> bool:  # noqa: ANN401
        from pxr import UsdGeom

        mesh, words = UsdGeom.Mesh(prim), UsdGeom.Tokens
        is_drawn = mesh and mesh.ComputePurpose() in (words.default_, words.render)
        return bool(is_drawn) and mesh.ComputeVisibility(self.time) != words.invisible

    def _of(self, mesh: Any, most: int) -> Iterator[Any]:  # noqa: ANN401
        """A mesh in its own frame, of at most so many triangles."""
        import trimesh
        from pxr import UsdShade

        names, counts = (
            np.array(one.Get(self.time), int)
            for one in (mesh.GetFaceVertexIndicesAttr(), mesh.GetFaceVertexCountsAttr())
        )
        points = np.array(mesh.GetPointsAttr().Get(self.time), float)
        problem = _problem_of(counts, names, len(points), most)
        if problem:
            raise DataError(f"{self.folder.file}: {mesh.GetPath()} {problem}")
        faces, corners = _fans(counts)
        vertices = points[names[corners]]
        where = {
            "faceVarying": corners,
            "uniform": np.repeat(faces[:, None], 3, 1),
            "constant": 0 * corners,
        }
        uv, painted = (
            self._primvar(mesh, kind, where, names[corners])
            for kind in ("texCoord2f[]", "color3f[]")
        )
        binding, rest, kinds = UsdShade.MaterialBindingAPI(mesh.GetPrim()), faces >= 0, []
        for subset in binding.GetMaterialBindSubsets():
            own = np.isin(faces, np.array(subset.GetIndicesAttr().Get(self.time)))
            kinds.append((UsdShade.MaterialBindingAPI(subset.GetPrim()), own))
            rest &= ~own
        for bound, rows in (*kinds, (binding, rest)):
            visual: Any = trimesh.visual.ColorVisuals()
            material = self._material(bound.ComputeBoundMaterial()[0])
            if material is not None:
                own_uv = None if uv is None else uv[rows].reshape(-1, 2)
                visual = trimesh.visual.TextureVisuals(own_uv, material)
            elif painted is not None:
                visual = trimesh.visual.ColorVisuals(vertex_colors=painted[rows].reshape(-1, 3))
            triangles = np.arange(3 * rows.sum()).reshape(-1, 3)
            if len(triangles):
                own_vertices = vertices[rows].reshape(-1, 3)
                yield trimesh.Trimesh(own_vertices, triangles, visual=visual, process=False)

    def _primvar(
        self,
        mesh: Any,  # noqa: ANN401
        kind: str,
        where: dict[str, Int[np.ndarray, "triangles 3"]],
        by_vertex: Int[np.ndarray, "triangles 3"],
    ) -> Float[np.ndarray, "triangles 3 width"] | None:
        """The first values of a kind that a mesh has, for each corner of its triangles."""
        from pxr import UsdGeom

        for one in UsdGeom.PrimvarsAPI(mesh).FindPrimvarsWithInheritance():
            if str(one.GetTypeName()) == kind and one.HasValue():
                values = np.array(one.ComputeFlattened(self.time), float)
                return values[where.get(one.GetInterpolation(), by_vertex)]
        return None

    def _material(self, material: Any) -> Any | None:  # noqa: ANN401
        """The colour of a material, as trimesh has it; None where there is none."""
        from trimesh.visual.material import PBRMaterial

        shader = material and (
            material.ComputeSurfaceSource()[0] or material.ComputeSurfaceSource("mdl")[0]
        )
        if not shader:
            return None
        said, image, factor = [self._input(shader, name) for name in COLOURS], None, None
        files: list[Any] = [one for one in said if getattr(one, "path", "")]
        plain = [one for one in said if one is not None and not hasattr(one, "resolvedPath")]
        if files:
            image, factor = self._image(files[0].resolvedPath), self._input(shader, TINT)
        elif plain:
            factor = plain[0]
        opacity = self._input(shader, "opacity")
        alpha = opacity if isinstance(opacity, float) else 1.0
        return PBRMaterial(
            baseColorFactor=np.clip([*((1, 1, 1) if factor is None else factor), alpha], 0, 1),
            baseColorTexture=image,
            alphaMode="BLEND" if alpha < 1 else "OPAQUE",
        )

    def _input(self, shader: Any, name: str) -> Any | None:  # noqa: ANN401
        """The value of an input, or the file of the texture that it is connected to."""
        from pxr import UsdShade

        found = shader.GetInput(name)
        for attribute in found.GetValueProducingAttributes() if found else ():
            if UsdShade.Output.IsOutput(attribute):
                return self._input(UsdShade.Shader(attribute.GetPrim()), "file")
            return attribute.Get(self.time)
        return None

    def _image(self, place: str) -> Any:  # noqa: ANN401
        """A texture, decoded once however many parts show it."""
        if place not in self.images:
            self.images[place] = opened_image(self.folder.file, self._bytes(place))
            load_images(self.folder.file, self.images.values())
        return self.images[place]

    def _bytes(self, place: str) -> bytes:
        """A file that a material names, in the package or the folder."""
        from pxr import Ar

        if place.startswith(f"{self.folder.file}["):
            return bytes(Ar.GetResolver().OpenAsset(Ar.ResolvedPath(place)).GetBuffer())
        return self.folder.get(place)


def _problem_of(
    counts: Int[np.ndarray, " polygons"],
    names: Int[np.ndarray, " corners"],
    num_points: int,
    most: int,
) -> str | None:
    """What is wrong with the polygons that a mesh says it has, if anything is.

    Asked before any memory is taken by these numbers, which may be anything.
    """
    is_odd = len(counts) and (counts.min() < 0 or counts.max() > len(names))
    if is_odd or counts.sum() != len(names):
        return "has polygons of more or fewer corners than it lists"
    if len(names) and (names.min() < 0 or names.max() >= num_points):
        return "names vertices that it does not have"
    if np.maximum(counts - 2, 0).sum() > most:
        return f"makes more than {MOST_TRIANGLES} triangles"
    return None


def _fans(
    counts: Int[np.ndarray, " polygons"],
) -> tuple[Int[np.ndarray, " triangles"], Int[np.ndarray, "triangles 3"]]:
    """Triangles of polygons: the polygon of each, and its places in the list of corners."""
    starts, sizes = np.cumsum(counts) - counts, np.maximum(counts - 2, 0)
    faces = np.repeat(np.arange(len(counts)), sizes)
    step = np.arange(len(faces)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return faces, starts[faces][:, None] + np.stack([0 * step, step + 1, step + 2], axis=1)
