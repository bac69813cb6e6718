"""Somebody else's splats and meshes, as actors in our box frame; and what is refused."""

import gzip
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from foreign_cars import (
    SIZE_M,
    WRITERS,
    taken,
    write_glb,
    write_obj,
    write_usd,
    write_usd_quads,
)
from PIL import Image

from lidarpainter_models.assets import foreign_files, foreign_meshes, foreign_usd, surface_gaussians
from lidarpainter_models.assets.foreign_files import ForeignFolder
from lidarpainter_models.assets.import_formats import IMPORT_FORMATS, import_format
from lidarpainter_models.assets.turntables import BACKGROUND, WIDTH_PX, turntable
from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.export.spz_files import write_spz
from lidarpainter_models.gaussians.model.ply_files import write_ply
from lidarpainter_models.metrics.images import psnr_from_error, squared_error


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """Fewer Gaussians, as far apart as a test needs."""
    monkeypatch.setattr(surface_gaussians, "MOST", 4000)


def coloured(model, *, above=(), below=()):
    """Centres of the Gaussians whose channels are above and below a half."""
    rgb = model.gaussians.base_rgb
    wanted = torch.ones(len(rgb), dtype=torch.bool)
    for channel in above:
        wanted &= rgb[:, channel] > 0.5
    for channel in below:
        wanted &= rgb[:, channel] < 0.4
    assert wanted.sum() > 5
    return model.gaussians.means[wanted]


@pytest.mark.parametrize("name", WRITERS)
def test_a_mesh_stands_in_the_box_frame_with_its_colours(name, tmp_path):
    model = taken(WRITERS[name](tmp_path / name))
    assert model.size_m.tolist() == pytest.approx(SIZE_M, abs=1e-4)
    assert 3500 < len(model.gaussians) < 4500
    assert coloured(model, above=(0, 1), below=(2,))[:, 1].min() > 0.8  # the plate, left
    assert coloured(model, above=(0, 1, 2))[:, 0].min() > 2.1  # lamps, ahead
    red_m = coloured(model, above=(0,), below=(1,))[:, 0]  # the rear, and maybe the seat
    assert red_m.min() < -2.2
    assert red_m.max() < 0.5
    assert coloured(model, above=(2,), below=(0,))[:, 2].max() == pytest.approx(0.75, abs=0.02)
    assert model.gaussians.means.abs().amax(0).le(model.size_m / 2 + 1e-4).all()


def test_what_lies_inside_is_left_out_unless_glass_shows_it(tmp_path):
    model = taken(write_glb(tmp_path / "car.glb"))
    rgb = model.gaussians.base_rgb
    is_engine = (rgb[:, 1] > 0.3) & (rgb[:, 0] < 0.25) & (rgb[:, 2] < 0.25)
    assert not is_engine.any()
    seat = coloured(model, above=(0,), below=(1, 2))
    assert len(seat) > 50
    glass = model.gaussians.opacity < 0.3
    assert 0.05 < glass.float().mean() < 0.6


def test_quads_and_subsets_of_usd_keep_their_materials(tmp_path):
    model = taken(write_usd_quads(tmp_path / "box.usda"), category="thing")
    assert model.size_m.tolist() == pytest.approx([4, 2, 1.5])
    is_red = model.gaussians.base_rgb[:, 0] > 0.5
    on_top = model.gaussians.means[:, 2] > 0.75 - 1e-4
    assert torch.equal(is_red, on_top)
    assert is_red.float().mean() == pytest.approx(8 / 34, abs=0.01)  # by area


def long_side(path, rgba):
    """What is seen of a box of 4 x 2 x 1 m from its left, in the middle: a row of pixels."""
    box = trimesh.creation.box((4, 2, 1))
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=rgba, alphaMode="BLEND")
    box.visual = trimesh.visual.TextureVisuals(material=material)
    pin = trimesh.creation.box((0.2, 0.2, 0.99))  # something must be solid
    pin.apply_translation((-1.8, 0, 0))
    trimesh.Scene([box, pin]).export(path)
    model = taken(path, category="thing", up="z", forward="x")
    strip = turntable(model.gaussians, model.size_m)
    return strip[46:50, 2 * WIDTH_PX + 56 : 2 * WIDTH_PX + 84].mean(2)


def test_gaussians_leave_no_gaps(tmp_path):
    seen = long_side(tmp_path / "box.glb", (1.0, 1, 1, 1))
    assert seen.std() < 0.01
    assert seen.mean() == pytest.approx(0.78, abs=0.02)  # white, that looks aside


def test_glass_is_as_clear_as_it_says(tmp_path):
    through = long_side(tmp_path / "box.glb", (0.0, 0, 0, 0.3)) / BACKGROUND
    assert through.mean() == pytest.approx(0.7**2, abs=0.04)  # in and out of the box
    assert through.std() < 0.1  # they are 8 cm apart here


def test_an_even_sky_lights_what_looks_up_most(tmp_path):
    box = trimesh.creation.box((4, 2, 1.5))
    box.visual = trimesh.visual.ColorVisuals(box, face_colors=[[102, 102, 102, 255]] * 12)
    box.export(tmp_path / "box.ply")
    model = taken(tmp_path / "box.ply")
    height_m, grey = model.gaussians.means[:, 2], model.gaussians.base_rgb[:, 0]
    assert grey[height_m > 0.74].median() == pytest.approx(0.4, abs=0.005)
    aside = grey[height_m.abs() < 0.5].median()
    assert grey[height_m < -0.74].median() < aside < 0.35


def test_black_wheels_are_not_taken_for_a_contact_shadow(tmp_path):
    model = taken(write_glb(tmp_path / "car.glb"))
    shadowed = model.with_shadow()
    assert len(shadowed.with_shadow().gaussians) == len(shadowed.gaussians)
    dark = (shadowed.gaussians.base_rgb < 0.01).all(1)
    wheels = dark & (shadowed.gaussians.means[:, 2] > -0.7)
    assert wheels.sum() > 100


def test_unit_axes_and_size_are_the_users_where_he_says_them(tmp_path):
    path = write_glb(tmp_path / "car.glb", scale=100.0)
    with pytest.raises(DataError, match=r"450 x 180 x 150 m, expected 2 to 8 m .* --size"):
        taken(path)
    model = taken(path, size_m=(4.6, 1.8, 1.5))
    assert model.size_m.tolist() == pytest.approx([4.6, 1.8, 1.5])
    assert model.gaussians.means[:, 0].max() == pytest.approx(2.3, abs=0.01)
    with pytest.raises(DataError, match=r"4.6 x 1.84 x 1.53 m at that length, expected about"):
        taken(path, size_m=(4.6, 1.0, 1.5))
    back = taken(path, size_m=(4.6, 1.8, 1.5), forward="-z")
    assert coloured(back, above=(0, 1, 2))[:, 0].max() < -2.1
    with pytest.raises(ConfigError, match="expected another axis than up"):
        taken(path, forward="y")
    with pytest.raises(DataError, match="--size, --up or --forward"):
        taken(path, size_m=(4.6, 1.8, 1.5), up="z")


def test_the_longest_side_is_the_length_but_of_people(tmp_path):
    trimesh.creation.box((0.4, 0.6, 1.7)).export(tmp_path / "who.ply")
    size_m = taken(tmp_path / "who.ply", category="sign").size_m.tolist()
    assert size_m == pytest.approx([0.6, 0.4, 1.7])
    size_m = taken(tmp_path / "who.ply", category="pedestrian").size_m.tolist()
    assert size_m == pytest.approx([0.4, 0.6, 1.7])


@pytest.mark.parametrize("ending", ["ply", "spz"])
def test_splats_that_go_out_and_come_in_are_the_same_car(ending, tmp_path):
    model = taken(write_glb(tmp_path / "car.glb"))
    path = tmp_path / f"out.{ending}"
    if ending == "ply":
        size = " ".join(f"{side:.4f}" for side in model.size_m.tolist())
        write_ply(path, model.gaussians, [f"size_m {size}"])
    else:
        write_spz(path, model.gaussians)
    again = taken(path)
    reach = 1e-3 if ending == "ply" else 0.12  # an SPZ file says no box: it is found again
    assert torch.allclose(again.size_m, model.size_m, atol=reach)
    strips = [turntable(one.gaussians, model.size_m) for one in (model, again)]
    psnr_db = psnr_from_error(float(squared_error(*strips).double().mean()))
    assert psnr_db > (60 if ending == "ply" else 30)


def test_splats_of_half_a_car_keep_the_box_that_the_file_says(tmp_path):
    model = taken(write_glb(tmp_path / "car.glb"))
    left = model.gaussians.select((model.gaussians.means[:, 1] > 0).nonzero()[:, 0])
    write_ply(tmp_path / "half.ply", left, ["size_m 4.5000 1.8000 1.5000"])
    again = taken(tmp_path / "half.ply")
    assert torch.allclose(again.gaussians.means, left.means, atol=1e-5)
    assert again.size_m.tolist() == pytest.approx([4.5, 1.8, 1.5])
    write_ply(tmp_path / "half.ply", left, ["size_m 2.1000 1.8000 1.5000"])
    with pytest.raises(DataError, match=r"reaches out of the box of 2.1 x 1.8 x 1.5 m"):
        taken(tmp_path / "half.ply")


def test_a_texture_is_part_of_what_a_file_is(tmp_path):
    path = write_obj(tmp_path / "car.obj")
    before = ForeignFolder(path)
    import_format(path).read(before)
    assert {one.suffix for one in before.digests} == {".obj", ".mtl", ".png"}
    (texture,) = tmp_path.glob("*.png")
    Image.new("RGB", (8, 8)).save(texture)
    after = ForeignFolder(path)
    import_format(path).read(after)
    assert set(before.digests.values()) != set(after.digests.values())


def hostile_obj(folder, said):
    path = write_obj(folder / "car.obj")
    (material,) = folder.glob("*.mtl")
    lines = material.read_text().splitlines()
    material.write_text("\n".join(said if "map_Kd" in one else one for one in lines))
    return path


def broken_texture(folder):
    path = write_obj(folder / "car.obj")
    (texture,) = folder.glob("*.png")
    texture.write_bytes(texture.read_bytes()[:20])
    return path


def hostile_gltf(folder, uri):
    path = write_glb(folder / "car.gltf")
    document = json.loads(path.read_text())
    document["buffers"][0]["uri"] = uri
    path.write_text(json.dumps(document))
    return path


def changed_gltf(folder, change):
    path = write_glb(folder / "car.gltf")
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    return path


def hostile_usd(folder, layer):
    from pxr import Sdf

    path = write_usd(folder / "car.usda")
    root = Sdf.Layer.FindOrOpen(str(path))
    prim = root.GetPrimAtPath("/World")
    prim.referenceList.prependedItems.append(Sdf.Reference(layer, "/Car"))
    root.Save()
    return path


def lying_usd(folder, counts=None, names=None):
    """A box of quads that says something else of its faces."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(write_usd_quads(folder / "box.usda")))
    (mesh,) = (UsdGeom.Mesh(one) for one in stage.Traverse() if one.IsA(UsdGeom.Mesh))
    if counts is not None:
        mesh.GetFaceVertexCountsAttr().Set(counts)
    if names is not None:
        mesh.GetFaceVertexIndicesAttr().Set(names)
    stage.Save()
    return folder / "box.usda"


def instanced_usd(folder):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(write_usd(folder / "car.usda")))
    UsdGeom.PointInstancer.Define(stage, "/World/Bolts")
    stage.Save()
    return folder / "car.usda"


def nowhere(folder):
    mesh = trimesh.creation.box((4, 2, 1.5))
    mesh.vertices[3] = np.nan
    mesh.export(folder / "car.ply")
    return folder / "car.ply"


def written(folder, name, content):
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_bytes(content)
    return folder / name


def beside(folder):
    """Files that the car's folder must not lead to."""
    other = folder.parent / "secret"
    other.mkdir()
    Image.new("RGB", (8, 8)).save(other / "secret.png")
    (other / "secret.bin").write_bytes(bytes(10**6))
    write_usd(other / "secret.usda")
    return other


OUT = "expected a file of its own folder"
HOSTILE = {
    "a texture above": (lambda f: hostile_obj(f, "map_Kd ../secret/secret.png"), OUT),
    "an absolute texture": (lambda f: hostile_obj(f, f"map_Kd {f.parent}/secret/secret.png"), OUT),
    "a texture far away": (lambda f: hostile_obj(f, "map_Kd http://a.b/c.png"), "is not there"),
    "a texture that lacks": (lambda f: hostile_obj(f, "map_Kd none.png"), "which is not there"),
    "a buffer above": (lambda f: hostile_gltf(f, "../secret/secret.bin"), OUT),
    "a buffer far away": (lambda f: hostile_gltf(f, "https://a.b/c.bin"), "is not there"),
    "a layer above": (lambda f: hostile_usd(f, "../secret/parts.usda"), OUT),
    "a layer far away": (lambda f: hostile_usd(f, "https://a.b/c.usda"), "is not there"),
    "a usd texture above": (
        lambda f: write_usd(f / "car.usda", texture="../secret/secret.png"),
        OUT,
    ),
    "a name of a nul": (lambda f: hostile_obj(f, "map_Kd a\0b.png"), "which is no file"),
    "a broken texture": (broken_texture, "its textures cannot be read"),
    "a texture in a glb that nobody reads": (
        lambda f: changed_gltf(
            f,
            lambda d: d["materials"][0].update(
                pbrMetallicRoughness={"baseColorTexture": {"index": 0}}
            ),
        ),
        "its textures cannot be read",
    ),
    "no car": (lambda f: written(f, "car.obj", b"PK\3\4 and more"), "0 triangles"),
    "an empty glb": (lambda f: written(f, "car.glb", b"glTF"), "no readable glTF"),
    "an empty usdz": (lambda f: written(f, "car.usdz", b"PK\3\4"), "no readable USD"),
    "an empty ply": (lambda f: written(f, "car.ply", b""), "cannot be read as ply"),
    "an empty spz": (lambda f: written(f, "car.spz", b""), "no readable SPZ"),
    "no numbers": (nowhere, "nan in its own unit, expected a thing with a volume"),
    "a flat thing": (
        lambda f: written(f, "car.obj", b"v 0 0 0\nv 4 0 0\nv 0 0 4\nf 1 2 3\n"),
        "4 x 4 x 0 in its own unit, expected a thing with a volume",
    ),
    "usd with a face of billions": (
        lambda f: lying_usd(f, counts=[2_000_000_000]),
        "more or fewer corners than it lists",
    ),
    "usd with a face of less than nothing": (
        lambda f: lying_usd(f, counts=[4, 4, 4, 4, 4, 8, -4]),
        "more or fewer corners than it lists",
    ),
    "usd with a vertex before the first": (
        lambda f: lying_usd(f, names=[-1, *range(1, 8)] * 3),
        "names vertices that it does not have",
    ),
    "usd with a vertex after the last": (
        lambda f: lying_usd(f, names=[8, *range(1, 8)] * 3),
        "names vertices that it does not have",
    ),
    "usd with instances at points": (instanced_usd, "/World/Bolts is a point instancer"),
    "an opacity that is no number": (
        lambda f: hostile_obj(f, "d much"),
        "expected a number",
    ),
    "columns without bytes": (
        lambda f: changed_gltf(f, lambda d: d["accessors"][0].pop("bufferView")),
        "packed columns",
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_would_do_harm_is_refused_in_a_line(name, tmp_path):
    make, expected = HOSTILE[name]
    folder = tmp_path / "car"
    folder.mkdir()
    beside(folder)
    path = make(folder)
    with pytest.raises(DataError, match=expected) as found:
        taken(path)
    assert len(str(found.value)) < 700


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_files_come_in_or_are_refused_in_a_line(name, tmp_path, monkeypatch):
    monkeypatch.setattr(surface_gaussians, "MOST", 300)
    path, random = WRITERS[name](tmp_path / name), np.random.default_rng(0)
    whole, refusals = path.read_bytes(), []
    for _ in range(25):
        content = bytearray(whole)
        for place in random.integers(0, min(len(content), 900), 3):
            content[place : place + 1] = [b"9999", b"\xff", b"nan", b"../"][place % 4]
        path.write_bytes(content)
        try:
            taken(path)
        except DataError as error:
            refusals.append(str(error))
    assert refusals
    assert not [said for said in refusals if "\n" in said]


def test_what_grows_beyond_reason_is_refused(tmp_path, monkeypatch):
    path = write_glb(tmp_path / "car.glb")
    monkeypatch.setattr(foreign_meshes, "MOST_TRIANGLES", 100)
    with pytest.raises(DataError, match="108 triangles, expected 1 to 100"):
        taken(path)
    monkeypatch.setattr(foreign_usd, "MOST_TRIANGLES", 11)
    with pytest.raises(DataError, match="/Box makes more than 11 triangles"):
        taken(write_usd_quads(tmp_path / "box.usda"), category="thing")
    monkeypatch.setattr(foreign_files, "MOST_BYTES", 100)
    with pytest.raises(DataError, match="larger than 0 MB"):
        taken(path)
    monkeypatch.undo()
    (tmp_path / "car.spz").write_bytes(gzip.compress(bytes(600 * 2**20), 1))
    with pytest.raises(DataError, match="unpacks to more than 512 MB"):
        taken(tmp_path / "car.spz")


def test_splats_that_show_nothing_or_stand_nowhere_are_refused(tmp_path):
    gaussians = taken(write_glb(tmp_path / "car.glb")).gaussians
    faint = replace(gaussians, opacity_logit=torch.full_like(gaussians.opacity_logit, -3))
    write_ply(tmp_path / "faint.ply", faint)
    with pytest.raises(DataError, match="nothing opaque"):
        taken(tmp_path / "faint.ply")
    with pytest.raises(ConfigError, match=r"car.zip: expected a name in .ply"):
        import_format(tmp_path / "car.zip")
    with pytest.raises(DataError, match="is not there"):
        ForeignFolder(tmp_path / "none.ply")


def test_every_ending_has_one_row():
    endings = [ending for row in IMPORT_FORMATS for ending in row.endings]
    assert len(set(endings)) == len(endings)
    assert all(row.up[-1] != row.forward[-1] for row in IMPORT_FORMATS)
