"""Textures and light of imported meshes: each texture once, bounded, and lit as it is seen."""

import json
import struct
import zlib

import numpy as np
import pytest
import trimesh
from foreign_cars import taken, write_obj, write_usd
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from lidarpainter_models.assets import foreign_images, surface_gaussians
from lidarpainter_models.assets.foreign_files import ForeignFolder
from lidarpainter_models.assets.foreign_meshes import read_gltf
from lidarpainter_models.assets.import_formats import import_format
from lidarpainter_models.assets.painted_parts import painted_parts
from lidarpainter_models.errors import DataError


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """Fewer Gaussians, as far apart as a test needs."""
    monkeypatch.setattr(surface_gaussians, "MOST", 2000)


def textured_boxes(path, colours, *, num_parts=1):
    """Boxes of 4 x 2 x 1 m beside each other; those of one colour share a texture."""
    scene = trimesh.Scene()
    for number, colour in enumerate(colours):
        material = PBRMaterial(baseColorTexture=Image.new("RGB", (8, 8), colour))
        for part in range(num_parts):
            box = trimesh.creation.box((4, 2, 1))
            box.visual = TextureVisuals(np.full((8, 2), 0.5), material)
            box.apply_translation((0, 0, 1.5 * (number * num_parts + part)))
            scene.add_geometry(box)
    scene.export(path)
    return path


def huge_png():
    """An image that says it has 10^10 pixels, and has none."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    sealed = header + struct.pack(">I", zlib.crc32(header))
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + sealed


def small_png(path, colour):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 8), colour).save(path)
    return path


def test_parts_that_share_a_texture_decode_it_once_and_become_one(tmp_path):
    path = textured_boxes(tmp_path / "boxes.glb", ["red", "blue"], num_parts=5)
    meshes = read_gltf(ForeignFolder(path)).meshes
    assert len(meshes) == 10
    assert len({id(one.visual.material.baseColorTexture) for one in meshes}) == 2
    parts = painted_parts(meshes, np.eye(4))
    assert [len(one.mesh.faces) for one in parts] == [60, 60]
    assert sum(one.mesh.area for one in parts) == pytest.approx(10 * 28)


def test_a_usd_texture_is_decoded_once_for_all_parts(tmp_path, monkeypatch):
    from pxr import Usd

    path, opened = write_usd(tmp_path / "car.usda"), []
    stage = Usd.Stage.Open(str(path))
    for number in range(3):
        copy = stage.DefinePrim(f"/World/Copy{number}", "Xform")
        copy.GetReferences().AddReference("./parts.usda")
    stage.Save()

    def counted(file, content):
        opened.append(file)
        return foreign_images.opened_image(file, content)

    monkeypatch.setattr("lidarpainter_models.assets.foreign_usd.opened_image", counted)
    shape = import_format(path).read(ForeignFolder(path))
    assert len(shape.meshes) == 4 * 9
    assert len(opened) == 1


def test_an_mtl_that_names_one_texture_often_decodes_it_once(tmp_path):
    small_png(tmp_path / "paint.png", "red")
    (tmp_path / "car.mtl").write_text("newmtl a\nmap_Kd paint.png\nnewmtl b\nmap_Kd paint.png\n")
    vertices = "v 0 0 0\nv 4 0 0\nv 0 2 0\nv 0 0 1\nvt 0 0\n"
    faces = "usemtl a\nf 1/1 2/1 3/1\nf 1/1 2/1 4/1\nusemtl b\nf 1/1 3/1 4/1\nf 2/1 3/1 4/1\n"
    (tmp_path / "car.obj").write_text(f"mtllib car.mtl\n{vertices}{faces}")
    row = import_format(tmp_path / "car.obj")
    meshes = row.read(ForeignFolder(tmp_path / "car.obj")).meshes
    assert len(meshes) == 2
    assert len({id(one.visual.material.image) for one in meshes}) == 1


@pytest.mark.parametrize("name", ["MOST_PIXELS", "MOST_PIXELS_OF_ALL"])
def test_textures_beyond_reason_are_refused_before_they_are_decoded(name, tmp_path, monkeypatch):
    path = textured_boxes(tmp_path / "boxes.glb", ["red", "blue"])
    monkeypatch.setattr(foreign_images, name, 8 * 8 + 60 if "ALL" in name else 60)
    monkeypatch.setattr(Image.Image, "load", None)
    with pytest.raises(DataError, match="a texture of 8 x 8 pixels is too large"):
        taken(path, category="thing")


def test_a_texture_with_a_huge_header_is_refused_in_a_line(tmp_path):
    path = write_usd(tmp_path / "usd" / "car.usda")
    (path.parent / "textures" / "body.png").write_bytes(huge_png())
    with pytest.raises(DataError, match=r"car.usda: its textures cannot be read"):
        taken(path)
    path = write_obj(tmp_path / "obj" / "car.obj")
    (texture,) = path.parent.glob("*.png")
    texture.write_bytes(huge_png())
    with pytest.raises(DataError, match=r"car.obj: its textures cannot be read"):
        taken(path)


def test_one_of_two_textures_that_is_lost_refuses_the_file(tmp_path):
    path = textured_boxes(tmp_path / "boxes.gltf", ["red", "blue"])
    document = json.loads(path.read_text())
    for number, image in enumerate(document["images"]):
        image.clear()
        image["uri"] = f"paint{number}.png"
    small_png(tmp_path / "paint0.png", "red")
    (tmp_path / "paint1.png").write_bytes(huge_png())
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match=r"its textures cannot be read .1 of 2"):
        taken(path, category="thing")
    small_png(tmp_path / "paint1.png", "blue")
    assert len(taken(path, category="thing").gaussians) > 1000


def test_a_percent_encoded_uri_names_a_file_of_the_folder_and_no_other(tmp_path):
    folder = tmp_path / "car"
    folder.mkdir()
    path = textured_boxes(folder / "boxes.gltf", ["red"])
    document = json.loads(path.read_text())
    document["images"] = [{"uri": "textures/Car%20Paint.png"}]
    path.write_text(json.dumps(document))
    small_png(folder / "textures" / "Car Paint.png", "blue")
    model = taken(path, category="thing")
    assert model.gaussians.base_rgb.mean(0).argmax() == 2
    small_png(tmp_path / "secret.png", "red")
    document["images"] = [{"uri": "%2E%2E/secret.png"}]
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match="expected a file of its own folder"):
        taken(path, category="thing")


@pytest.mark.parametrize("tint", [None, (1.0, 0.5, 1.0)])
def test_a_texture_of_omnipbr_is_tinted_and_not_darkened(tint, tmp_path):
    from pxr import Gf, Sdf, Usd, UsdShade

    path = write_usd(tmp_path / "car.usda")
    small_png(tmp_path / "textures" / "white.png", "white")
    stage, types = Usd.Stage.Open(str(tmp_path / "parts.usda")), Sdf.ValueTypeNames
    shader = UsdShade.Shader(stage.GetPrimAtPath("/Car/Looks/rear/Shader"))
    shader.CreateInput("diffuse_texture", types.Asset).Set("./textures/white.png")
    shader.CreateInput("diffuse_color_constant", types.Color3f).Set(Gf.Vec3f(0.2, 0.2, 0.2))
    if tint:
        shader.CreateInput("diffuse_tint", types.Color3f).Set(Gf.Vec3f(*tint))
    stage.Save()
    shape = import_format(path).read(ForeignFolder(path))
    materials = [getattr(one.visual, "material", None) for one in shape.meshes]
    (factor,) = (
        one.baseColorFactor
        for one in materials
        if one is not None
        and one.baseColorTexture is not None
        and one.baseColorTexture.getpixel((0, 0))[:3] == (255, 255, 255)
    )
    assert factor.tolist() == [255, 255 if tint is None else 128, 255, 255]


def test_the_bed_of_a_pickup_is_lit_by_the_sky(tmp_path):
    """A floor below the middle of the box between walls, whichever way round it is wound."""
    floor = np.array([[-2, -1, 0.2], [2, -1, 0.2], [2, 1, 0.2], [-2, 1, 0.2]])
    walls = [trimesh.creation.box((4, 0.1, 1.5)) for _ in range(2)]
    for wall, side in zip(walls, (-1, 1), strict=True):
        wall.apply_translation((0, side, 0.75))
    for faces in ([[0, 1, 2], [0, 2, 3]], [[2, 1, 0], [3, 2, 0]]):
        whole = trimesh.util.concatenate([*walls, trimesh.Trimesh(floor, faces, process=False)])
        colours = np.tile(np.uint8([102, 102, 102, 255]), (len(whole.vertices), 1))
        whole.visual = trimesh.visual.ColorVisuals(whole, vertex_colors=colours)
        whole.export(tmp_path / "bed.ply")
        model = taken(tmp_path / "bed.ply", category="thing")
        means, grey = model.gaussians.means, model.gaussians.base_rgb[:, 0]
        on_floor = ((means[:, 2] + 0.55).abs() < 0.01) & (means[:, 1].abs() < 0.9)
        assert on_floor.sum() > 50
        assert grey[on_floor].min() == pytest.approx(0.4, abs=0.005)


def test_what_is_mostly_hidden_costs_a_bounded_number_of_places(tmp_path, monkeypatch):
    monkeypatch.setattr(surface_gaussians, "SPACING_M", 1e-4)
    shells = [trimesh.creation.box((4, 2, 1.5))]
    shells += [trimesh.creation.box((3.9, 1.9, 1.4)) for _ in range(60)]
    trimesh.util.concatenate(shells).export(tmp_path / "box.ply")
    counts, places = [], surface_gaussians._places

    def counted(part, count, is_linear):
        counts.append(count)
        return places(part, count, is_linear)

    monkeypatch.setattr(surface_gaussians, "_places", counted)
    taken(tmp_path / "box.ply", category="thing")
    most = surface_gaussians.MOST_TRIED * surface_gaussians.MOST
    assert counts[0] == pytest.approx(surface_gaussians.MOST)
    assert surface_gaussians.MOST < counts[1] <= most * 1.001
    assert len(counts) == 2


def test_a_file_is_what_lies_where_and_not_how_it_is_called(tmp_path):
    def contents(path):
        folder = ForeignFolder(path)
        import_format(path).read(folder)
        return folder.contents

    paths = [textured_boxes(tmp_path / f"boxes{one}.gltf", ["red", "blue"]) for one in range(2)]
    document = json.loads(paths[0].read_text())
    for number, image in enumerate(document["images"]):
        image.clear()
        image["uri"] = f"paint{number}.png"
    for path in paths:
        path.write_text(json.dumps(document))
    for number, colour in enumerate(("red", "blue")):
        small_png(tmp_path / f"paint{number}.png", colour)
    before = contents(paths[0])
    assert contents(paths[1]) == before
    for number, colour in enumerate(("blue", "red")):
        small_png(tmp_path / f"paint{number}.png", colour)
    after = contents(paths[0])
    assert after != before
    assert sorted(digest for _, digest in after) == sorted(digest for _, digest in before)
