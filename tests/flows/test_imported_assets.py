"""Other people's files in the library: entered, found, exported, and driving in a scene."""

import numpy as np
import pytest
from commands import refuse, succeed
from foreign_cars import SIZE_M, write_glb, write_obj
from pygltflib import GLTF2

from catalog.store import open_store
from lidarpainter_models.gaussians.model.ply_files import read_ply
from tasks.runs import open_run
from tasks.serving.library import StoredActors
from tasks.stored import load_scene


@pytest.fixture(scope="module")
def car(tmp_path_factory):
    return write_glb(tmp_path_factory.mktemp("foreign") / "taxi.glb")


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """A store that holds nothing else; `assets import` makes it."""
    return open_store(tmp_path_factory.mktemp("library") / "store")


def imported(library, path, *words):
    return succeed("assets", "import", path, *words, "--json", store=library).json


@pytest.fixture(scope="module")
def asset(library, car):
    return imported(library, car, "--category", "Car", "--licence", "CC BY 4.0")


def test_a_file_becomes_an_actor_that_the_library_finds(library, asset, tmp_path):
    found = succeed("assets", "list", "--dataset", "imported", "--json", store=library).json
    (row,) = found["assets"]
    assert row["asset_id"] == asset["asset_id"]
    assert (row["kind"], row["category"], row["licence"]) == ("actor", "car", "CC BY 4.0")
    assert [row["length_m"], row["width_m"], row["height_m"]] == pytest.approx(SIZE_M, abs=1e-4)
    assert row["score"] is row["sides"] is None  # no camera saw it
    sql = "SELECT count(*) AS n FROM assets WHERE dataset = 'imported'"
    assert succeed("assets", "query", sql, "--json", store=library).json["rows"] == [{"n": 1}]
    shown = succeed("assets", "show", row["asset_id"][:8], "--json", store=library).json
    assert shown["made_from"]["stale"] == []
    words = ("assets", "gallery", "--out", tmp_path / "page", "--json")
    assert succeed(*words, store=library).json["num_pictures"] == 1
    assert not succeed("catalog", "gc", "--days", 0, "--json", store=library).json["rows"]
    assert StoredActors(library).names == [row["asset_id"]]


def test_the_same_file_again_changes_nothing_and_options_correct_it(library, asset, car):
    before = [library.tables.rows(table) for table in ("assets", "sightings")]
    again = imported(library, car, "--category", "car", "--licence", "CC BY 4.0")
    assert (again["asset_id"], again["is_new"]) == (asset["asset_id"], False)
    assert [library.tables.rows(table) for table in ("assets", "sightings")] == before
    turned = imported(library, car, "--category", "car", "--forward", "-z")
    assert (turned["asset_id"], turned["forward"]) == (asset["asset_id"], "-z")
    (row,) = library.tables.rows("assets")
    assert row["licence"] == "CC BY 4.0"  # nobody took it back
    imported(library, car, "--category", "car", "--licence", "CC BY 4.0")
    assert [library.tables.rows(table) for table in ("assets", "sightings")] == before


def test_an_asset_goes_out_in_every_format_with_its_box(library, asset, tmp_path):
    from pxr import Usd, UsdGeom

    for format_, name in (("ply", "a.ply"), ("gltf", "a.glb"), ("usd", "a.usdz"), ("spz", "a.spz")):
        words = ("--format", format_, "--out", tmp_path / name)
        succeed("assets", "export", asset["asset_id"], *words, store=library)
    exact = read_ply(tmp_path / "a.ply")
    assert b"comment size_m 4.5000 1.8000 1.5000\n" in (tmp_path / "a.ply").read_bytes()
    document = GLTF2().load(tmp_path / "a.glb")
    (primitive,) = document.meshes[0].primitives
    position = document.accessors[primitive.attributes.POSITION]
    assert position.count == len(exact)
    assert position.max == pytest.approx(exact.means.amax(0).tolist())  # in our box frame
    stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    fields = [one for one in stage.Traverse() if "ParticleField" in one.GetTypeName()]
    (field,) = fields
    assert np.allclose(field.GetAttribute("positions").Get(), exact.means)
    assert np.allclose(field.GetAttribute("opacities").Get(), exact.opacity, atol=1e-6)
    sh = np.array(field.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get())
    assert np.allclose(sh, exact.sh[:, 0], atol=1e-6)
    for name in ("a.ply", "a.spz"):
        again = imported(library, tmp_path / name, "--category", "car")
        assert again["asset_id"] != asset["asset_id"]
        sides = [again[side] for side in ("length_m", "width_m", "height_m")]
        assert sides == pytest.approx(SIZE_M, abs=1e-3 if name == "a.ply" else 0.12)


def test_an_imported_car_drives_in_a_scene_with_its_shadow(own_run, car, tmp_path):
    store = own_run.store
    asset = imported(store, car, "--category", "car")["asset_id"]
    words = ("insert", "guest", f"source=asset:{asset}", "ahead_m=9", "--out", tmp_path / "seen")
    edited = succeed("edit", own_run.run_id, *words, "--allow-collisions", "--json", store=store)
    scene = load_scene(store, open_run(store, edited.json["run_id"]).final.gaussians)
    (number,) = (n for n, one in enumerate(scene.tracks, 1) if one.actor_id == "guest")
    own = scene.gaussians.select((scene.gaussians.body_index == number).nonzero()[:, 0])
    is_shadow = own.means[:, 2] < 0.1 - SIZE_M[2] / 2
    assert (own.base_rgb[is_shadow] < 1e-4).all(1).sum() > 50
    assert own.means[:, 2].min() > -SIZE_M[2] / 2 - 1e-3
    blue = own.base_rgb[(own.base_rgb[:, 2] > 1.5 * own.base_rgb[:, 0]) & ~is_shadow]
    assert len(blue) > 1000


@pytest.mark.parametrize(
    ("name", "words", "expected"),
    [
        ("car.zip", (), "car.zip: expected a name in .ply"),
        ("none.glb", (), "none.glb is not there"),
        ("bad.ply", (), "bad.ply: cannot be read as ply"),
        ("car.obj", ("--size", "4,2"), "--size '4,2': expected three metres"),
        ("car.obj", ("--size", "4,2,0"), "--size: expected three lengths in metres"),
        ("car.obj", ("--size", "400,160,133"), "expected 2 to 8 m for the longest side of a car"),
        ("car.obj", ("--forward", "y"), "expected another axis than up, y"),
        ("car.obj", ("--category", " "), "--category is empty"),
    ],
)
def test_what_cannot_come_in_is_one_line_and_enters_nothing(name, words, expected, tmp_path):
    store = open_store(tmp_path / "store")
    write_obj(tmp_path / "car.obj")
    (tmp_path / "bad.ply").write_bytes(b"ply\n\x00")
    given = words if "--category" in words else ("--category", "car", *words)
    assert expected in refuse("assets", "import", tmp_path / name, *given, store=store)
    assert not list(tmp_path.glob("store/artefacts/*/*"))
    assert store.tables.rows("assets") == []
