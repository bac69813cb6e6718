"""A car as others would hand it over: a blue body, glass around a red seat, lamps, black wheels.

Its left side bears a yellow plate, so that whoever mirrors or turns it is found out.
"""

from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from lidarpainter_models.assets.foreign_files import ForeignFolder
from lidarpainter_models.assets.import_formats import import_format
from lidarpainter_models.assets.placing import Placement, placed_actor

SIZE_M = (4.5, 1.8, 1.5)
GLTF_FROM_BOX = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
"""x left, y up, z ahead."""
PARTS = {  # size, centre, colour in linear light with opacity
    "body": ((4.4, 1.7, 0.5), (0, 0, -0.2), (0.05, 0.1, 0.6, 1)),
    "roof": ((1.8, 1.5, 0.1), (-0.3, 0, 0.7), (0.05, 0.1, 0.6, 1)),
    "glass": ((1.8, 1.5, 0.6), (-0.3, 0, 0.35), (0.02, 0.02, 0.02, 0.3)),
    "seat": ((0.9, 0.9, 0.3), (-0.3, 0, 0.25), (0.6, 0.03, 0.02, 1)),
    "engine": ((0.8, 0.8, 0.2), (1.4, 0, -0.2), (0.02, 0.5, 0.02, 1)),
    "plate": ((0.8, 0.06, 0.3), (0, 0.87, -0.2), (0.9, 0.7, 0, 1)),
    "lamps": ((0.06, 1.2, 0.2), (2.22, 0, -0.1), (0.9, 0.9, 0.9, 1)),
    "rear": ((0.06, 1.2, 0.2), (-2.22, 0, -0.1), (0.7, 0.0, 0.3, 1)),
    "wheels": ((3.4, 1.8, 0.3), (0, 0, -0.6), (0, 0, 0, 1)),
}


def boxes():
    """Part by part, with its colour, in the box frame."""
    for name, (size_m, centre_m, rgba) in PARTS.items():
        pose = trimesh.transformations.translation_matrix(centre_m)
        yield name, trimesh.creation.box(size_m, transform=pose), rgba


def srgb(rgba):
    """Linear light as bytes of a picture."""
    light = np.array(rgba[:3], float)
    shown = np.where(light > 0.0031308, 1.055 * light ** (1 / 2.4) - 0.055, light * 12.92)
    return (np.append(shown, rgba[3]) * 255).round().astype(np.uint8)


def painted(mesh, rgba):
    """Vertices in one colour of a picture."""
    mesh.visual = ColorVisuals(mesh, vertex_colors=np.tile(srgb(rgba), (len(mesh.vertices), 1)))
    return mesh


def write_glb(path, *, scale=1.0):
    """As glTF, y up, z ahead; glass is see-through."""
    scene = trimesh.Scene()
    for name, mesh, rgba in boxes():
        mesh.apply_transform(GLTF_FROM_BOX)
        mesh.apply_scale(scale)
        mode = "BLEND" if rgba[3] < 1 else "OPAQUE"
        material = PBRMaterial(baseColorFactor=rgba, alphaMode=mode)
        part = trimesh.Trimesh(mesh.vertices, mesh.faces, visual=TextureVisuals(material=material))
        scene.add_geometry(part, node_name=name, geom_name=name)
    path.parent.mkdir(parents=True, exist_ok=True)
    scene.export(path)
    return path


def write_ply(path):
    """As PLY, z up, x ahead, with colours of vertices."""
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.util.concatenate([painted(mesh, rgba) for _, mesh, rgba in boxes()]).export(path)
    return path


def write_obj(path):
    """As OBJ, y up, z ahead; one texture has a column for each part."""
    names, parts, columns = list(PARTS), [], []
    for _, mesh, rgba in boxes():
        parts.append(mesh.apply_transform(GLTF_FROM_BOX))
        columns.append(np.tile(srgb(rgba)[:3], (8, 8, 1)))
    image = Image.fromarray(np.concatenate(columns, axis=1))
    uv = [
        np.full((len(mesh.vertices), 2), ((number + 0.5) / len(names), 0.5))
        for number, mesh in enumerate(parts)
    ]
    whole: Any = trimesh.util.concatenate([trimesh.Trimesh(m.vertices, m.faces) for m in parts])
    material = SimpleMaterial(image=image, diffuse=[255, 255, 255, 255])
    whole.visual = TextureVisuals(np.concatenate(uv), material)
    path.parent.mkdir(parents=True, exist_ok=True)
    whole.export(path)
    return path


def write_usd(path, *, texture="./textures/body.png"):
    """As OpenUSD, z up, in centimetres, looking along y; the parts are in a layer of their own."""
    from pxr import Sdf, Usd, UsdGeom

    (path.parent / "textures").mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 8), tuple(srgb(PARTS["body"][2])[:3])).save(
        path.parent / "textures" / "body.png"
    )
    path.with_name("OmniPBR.mdl").write_text("mdl 1.0;")  # a package must have it, nobody reads it
    parts = Usd.Stage.CreateNew(str(path.with_name("parts.usda")))
    parts.SetDefaultPrim(UsdGeom.Xform.Define(parts, "/Car").GetPrim())
    for name, mesh, rgba in boxes():
        _usd_part(parts, name, mesh, rgba, texture if name == "body" else None)
    parts.Save()
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    car = UsdGeom.Xform.Define(stage, Sdf.Path("/World"))
    stage.SetDefaultPrim(car.GetPrim())
    car.GetPrim().GetReferences().AddReference("./parts.usda")
    car.AddRotateZOp().Set(90.0)
    stage.Save()
    return path


def _usd_part(stage, name, mesh, rgba, texture):
    """Quads with a preview material; glass is one of NVIDIA's, wheels have colours only."""
    from pxr import Gf, Sdf, UsdGeom, UsdShade

    one = UsdGeom.Mesh.Define(stage, f"/Car/{name}")
    one.GetPointsAttr().Set([Gf.Vec3f(*map(float, point)) for point in mesh.vertices * 100])
    one.GetFaceVertexCountsAttr().Set([3] * len(mesh.faces))
    one.GetFaceVertexIndicesAttr().Set(mesh.faces.reshape(-1).tolist())
    if name == "wheels":
        one.CreateDisplayColorAttr([Gf.Vec3f(*rgba[:3])])
        return
    types, place = Sdf.ValueTypeNames, f"/Car/Looks/{name}"
    material = UsdShade.Material.Define(stage, place)
    shader = UsdShade.Shader.Define(stage, f"{place}/Shader")
    UsdShade.MaterialBindingAPI.Apply(one.GetPrim()).Bind(material)
    if name == "rear":
        shader.SetSourceAsset(Sdf.AssetPath("OmniPBR.mdl"), "mdl")
        shader.CreateInput("diffuse_color_constant", types.Color3f).Set(Gf.Vec3f(*rgba[:3]))
        material.CreateSurfaceOutput("mdl").ConnectToSource(shader.CreateOutput("out", types.Token))
        return
    shader.CreateIdAttr("UsdPreviewSurface")
    colour = shader.CreateInput("diffuseColor", types.Color3f)
    shader.CreateInput("opacity", types.Float).Set(float(rgba[3]))
    if texture is None:
        colour.Set(Gf.Vec3f(*rgba[:3]))
    else:
        primvar = UsdGeom.PrimvarsAPI(one).CreatePrimvar("st", types.TexCoord2fArray, "constant")
        primvar.Set([Gf.Vec2f(0.5, 0.5)])
        image = UsdShade.Shader.Define(stage, f"{place}/Image")
        image.CreateIdAttr("UsdUVTexture")
        image.CreateInput("file", types.Asset).Set(texture)
        colour.ConnectToSource(image.CreateOutput("rgb", types.Float3))
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", types.Token))


def write_usdz(path):
    """The same, packed."""
    from pxr import UsdUtils

    loose = write_usd(path.parent / "loose" / "car.usda")
    assert UsdUtils.CreateNewUsdzPackage(str(loose), str(path))
    return path


WRITERS = {
    "car.obj": write_obj,
    "car.glb": write_glb,
    "car.gltf": write_glb,
    "car.ply": write_ply,
    "car.usda": write_usd,
    "car.usdz": write_usdz,
}
"""By the name of the file."""


def write_usd_quads(path):
    """A box of quads, y up, in metres: its top is red by a subset, all else green."""
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    box = UsdGeom.Mesh.Define(stage, "/Box")
    corners = [(x, y, z) for x in (-1, 1) for y in (-0.75, 0.75) for z in (-2, 2)]
    box.GetPointsAttr().Set([Gf.Vec3f(*map(float, one)) for one in corners])
    quads = [(2, 3, 7, 6), (0, 4, 5, 1), (0, 1, 3, 2), (4, 6, 7, 5), (0, 2, 6, 4), (1, 5, 7, 3)]
    box.GetFaceVertexCountsAttr().Set([4] * 6)
    box.GetFaceVertexIndicesAttr().Set([corner for quad in quads for corner in quad])
    top = UsdGeom.Subset.CreateGeomSubset(box, "top", UsdGeom.Tokens.face, [0])
    UsdShade.MaterialBindingAPI.Apply(box.GetPrim()).SetMaterialBindSubsetsFamilyType(
        UsdGeom.Tokens.nonOverlapping
    )
    top.GetFamilyNameAttr().Set("materialBind")
    for prim, rgb in ((top.GetPrim(), (0.8, 0, 0)), (box.GetPrim(), (0, 0.8, 0))):
        place = f"/Looks{prim.GetPath().name}"
        material = UsdShade.Material.Define(stage, place)
        shader = UsdShade.Shader.Define(stage, f"{place}/Shader")
        shader.CreateIdAttr("UsdPreviewSurface")
        shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*rgb))
        output = shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
        material.CreateSurfaceOutput().ConnectToSource(output)
        UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)
    stage.Save()
    return path


def taken(path, **said):
    """The actor that a file becomes; a car unless it is said otherwise."""
    row = import_format(path)
    shape = row.read(ForeignFolder(path))
    return placed_actor(shape, row, Placement(**{"category": "car", **said}))[0]
