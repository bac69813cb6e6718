"""The library of assets: what it answers, and a run's assets from publishing to deletion."""

import json

import pytest
import torch
from commands import call, complaint, refuse, succeed
from tiny_street import SCENE, SETTINGS

from flows.fleet.asked_sequences import Asked
from flows.fleet.work import make_sequence
from lidarpainter_models.assets.asset_files import read_asset
from lidarpainter_models.export.spz_files import read_spz
from lidarpainter_models.gaussians.model.ply_files import read_ply
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.serving.refusals import RequestError
from tasks.runs import open_run
from tasks.serving.library import StoredActors
from tasks.stored import load_scene


@pytest.fixture(scope="module")
def published(own_run):
    return succeed("assets", "publish", own_run.run_id, "--json", store=own_run.store).json


@pytest.fixture(scope="module")
def library(own_run, published):  # noqa: ARG001 - it is published into it
    """A store with the assets of one run."""
    return own_run.store


def listed(library, *words):
    return succeed("assets", "list", "--limit", 1000, "--json", *words, store=library).json[
        "assets"
    ]


@pytest.fixture(scope="module")
def actor(library):
    return listed(library, "--kind", "actor")[0]


def test_list_filters_and_sorts(library):
    everything, actors = listed(library), listed(library, "--kind", "actor")
    assert {row["kind"] for row in everything} == {"actor", "street", "sky", "trajectory"}
    assert 0 < len(actors) < len(everything)
    scores = [row["score"] for row in actors]
    assert scores == sorted(scores, reverse=True)
    some = listed(library, "--kind", "actor", "--sides", "left,rear", "--min-score", scores[1])
    assert some == [row for row in actors[:2] if {"left", "rear"} <= set(row["sides"])]
    first = succeed("assets", "list", "--limit", 1, "--sort", "length_m", store=library)
    assert max(everything, key=lambda row: row["length_m"] or 0)["asset_id"][:12] in first.out
    assert "--limit shows more" in first.out


def test_show_tells_sightings_and_goes_back_to_what_the_scene_was_read_from(library, actor):
    name = actor["asset_id"][:10]
    found = succeed("assets", "show", name, "--json", store=library).json
    assert found["asset_id"] == actor["asset_id"]
    assert [one["actor_id"] for one in found["sightings"]] == [actor["actor_id"]]
    scene = found["made_from"]["inputs"]["scene"]
    assert scene["name"] == actor["scene_ids"][0]
    manifest = DrivingScene.open(library.scene_folder(scene["name"])).manifest
    assert scene["read_from"] == manifest["provenance"]
    assert "gaussians" in found["made_from"]["inputs"]
    said = succeed("assets", "show", name, store=library).out
    assert all(text in said for text in (actor["name"], "sightings", "made from"))


def test_query_answers_sql_and_nothing_else(library):
    text = "SELECT kind, count(*) AS n, list(distinct sides) AS s FROM assets GROUP BY kind"
    found = succeed("assets", "query", text, "--json", store=library).json
    assert {row["kind"]: row["n"] for row in found["rows"]}["sky"] == 1
    assert "trajectory" in succeed("assets", "query", text, store=library).out
    odd = "SELECT 1.5::DECIMAL(9,2) AS a, DATE '2026-01-02' AS b, 'nan'::DOUBLE AS c, [1] AS d"
    (row,) = succeed("assets", "query", odd, "--json", store=library).json["rows"]
    assert row == {"a": "1.50", "b": "2026-01-02", "c": None, "d": [1]}


def test_export_writes_what_was_published(library, actor, tmp_path):
    for ending in ("ply", "spz", "glb"):
        out = tmp_path / f"car.{ending}"
        format_ = "gltf" if ending == "glb" else ending
        words = ("--format", format_, "--out", out, "--json")
        result = succeed("assets", "export", actor["asset_id"], *words, store=library).json
        assert result["num_gaussians"] == actor["num_gaussians"]
        assert result["num_bytes"] == out.stat().st_size
    exact, coarse = read_ply(tmp_path / "car.ply"), read_spz(tmp_path / "car.spz")
    assert len(exact) == len(coarse) == actor["num_gaussians"]
    assert (exact.means - coarse.means).abs().max() < 1e-3  # steps of 1/4096 m
    assert exact.means.abs().max() < actor["length_m"]  # its own frame, not the world


def test_gallery_is_written_anew_in_place_of_an_older_one_only(library, tmp_path):
    out = tmp_path / "gallery"
    result = succeed("assets", "gallery", "--out", out, "--json", store=library).json
    assert result["num_assets"] == len(listed(library))
    assert len(list((out / "thumbnails").iterdir())) == result["num_pictures"] > 3
    few = succeed("assets", "gallery", "--out", out, "--limit", 2, "--json", store=library).json
    assert (few["num_assets"], few["is_cut"]) == (2, True)
    assert len(list((out / "thumbnails").iterdir())) == 2
    assert json.loads((out / "assets.js").read_text().removeprefix("const LIBRARY = ")[:-2])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "work.txt").write_text("kept")
    answer = call("assets", "gallery", "--out", tmp_path / "mine", store=library)
    assert (answer.code, answer.out) == (2, "")
    assert "is there already" in answer.err
    assert (tmp_path / "mine" / "work.txt").read_text() == "kept"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("list", "--category", "tram"), "no asset of category 'tram'; there are"),
        (("list", "--sides", "below"), "no side 'below', expected some of front"),
        (("list", "--sort", "beauty"), "--sort"),
        (("show", "none"), "no asset 'none'"),
        (("export", "none", "--format", "ply", "--out", "x.ply"), "no asset 'none'"),
        (("query", "SELECT * FROM read_csv('/etc/passwd')"), "file system operations are disabled"),
        (("query", "DROP TABLE assets"), "a query is one SELECT"),
    ],
)
def test_what_cannot_be_answered_is_one_line(library, words, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    answer = call("assets", *words, store=library)
    assert (answer.code, answer.out) == (2, "")
    assert expected in answer.err
    assert list(tmp_path.iterdir()) == []


def test_only_what_has_gaussians_is_exported_under_its_ending(library, actor, tmp_path):
    (sky,) = listed(library, "--kind", "sky")
    for asset, out, expected in (
        (sky, "sky.ply", "a sky has no Gaussians"),
        (actor, "car.obj", "expected a name in .ply"),
    ):
        words = ("--format", "ply", "--out", tmp_path / out)
        assert expected in refuse("assets", "export", asset["asset_id"], *words, store=library)


def test_a_row_that_leads_out_of_the_store_is_refused(library, actor, tmp_path):
    row = library.tables.row("assets", actor["asset_id"])
    for column in ("folder", "artefact_id"):
        hostile = "../../../../etc" if column == "folder" else "../../etc"
        library.tables.merge("assets", [{**row, "asset_id": "hostile", column: hostile}])
        words = ("--format", "ply", "--out", tmp_path / "x.ply")
        assert "leads out of the store" in refuse(
            "assets", "export", "hostile", *words, store=library
        )
    library.tables.delete("assets", "asset_id", ["hostile"])


def rows(store, table="assets", **columns):
    found = store.tables.rows(table)
    return [row for row in found if all(row[name] == value for name, value in columns.items())]


def test_a_run_yields_actors_street_sky_and_trajectories(own_run, published):
    (result,) = published["published"]
    store = own_run.store
    kinds = {row["kind"] for row in rows(store)}
    assert kinds == {"actor", "street", "sky", "trajectory"}
    assert result["num_assets"] == len(rows(store)) == len(rows(store, "sightings"))
    for row in rows(store, kind="actor"):
        folder = store.root / "artefacts" / row["artefact_id"]
        assert (folder / row["thumbnail"]).is_file()
        model = read_asset(folder / row["folder"])
        assert len(model.gaussians) == row["num_gaussians"] >= 20
        assert len(model.points) == row["num_points"]
        assert 0 <= row["score"] <= 1
        assert row["judged_on"] == "held-out"


def test_publishing_again_changes_nothing(own_run, published):
    store = own_run.store
    before = [store.tables.rows(table) for table in ("assets", "sightings")]
    (again,) = succeed("assets", "publish", own_run.run_id, "--json", store=store).json["published"]
    assert not again["is_new"]
    assert again["assets"] == published["published"][0]["assets"]
    assert [store.tables.rows(table) for table in ("assets", "sightings")] == before


def best_actor(store):
    return max(rows(store, kind="actor", style=None), key=lambda row: row["score"])["asset_id"]


def test_an_actor_of_the_library_drives_in_a_scene(library, own_run):
    store, asset = library, best_actor(library)
    words = ("edit", own_run.run_id, "insert", "guest", f"source=asset:{asset[:8]}", "ahead_m=9")
    first = succeed(*words, "--allow-collisions", "--json", store=store).json
    run = open_run(store, first["run_id"])
    tracks = load_scene(store, run.final.gaussians).tracks
    (guest,) = (track for track in tracks if track.actor_id == "guest")
    known = store.tables.find("assets", asset)
    size_m = [known["length_m"], known["width_m"], known["height_m"]]
    assert guest.size_m.tolist() == pytest.approx(size_m, abs=1e-5)
    again = succeed(*words, "--allow-collisions", "--json", store=store).json
    assert again["run_id"] == first["run_id"]
    assert not any(again["computed_now"].values())
    assert "expected a recorded or styled one" in refuse(
        "assets", "publish", first["run_id"], store=store
    )


def test_a_server_takes_the_actor_that_is_nearest_in_class_and_size(library):
    actors, best = StoredActors(library), best_actor(library)
    model = actors.model(best[:8])
    assert set(actors.names) == {row["asset_id"] for row in rows(library, kind="actor", style=None)}
    found = actors.model(actors.nearest(model.category, model.size_m))
    assert torch.allclose(found.size_m, model.size_m)
    assert actors.nearest("zeppelin", None) in actors.names  # of no such class: of all
    with pytest.raises(RequestError, match="asset 'zebra': no asset 'zebra'"):
        actors.model("zebra")


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("asset:zebra", "no asset 'zebra'"),
        ("asset:", "source.asset: String should have at least 1 character"),
        ("zebra", "source: Input should be"),
    ],
)
def test_an_asset_that_cannot_be_put_in_is_one_line(library, own_run, source, expected):
    words = ("edit", own_run.run_id, "insert", "guest", f"source={source}")
    assert expected in complaint(*words, store=library)


def test_streets_are_not_put_in_like_actors(library, own_run):
    street = rows(library, kind="street")[0]["asset_id"]
    words = ("edit", own_run.run_id, "insert", "guest", f"source.asset={street}")
    assert "is a street, expected an actor" in call(*words, store=library).err


def test_a_fleet_publishes_a_scene_and_its_variants(library):
    """Observations and the first fit are those of the run that is there."""
    dataset, _, sequence = SCENE.partition("/")
    asked = Asked(
        dataset=dataset,
        sequence=sequence,
        preset="preview",
        painter="none",
        settings=(*SETTINGS, "rounds=0"),
        scores=False,
        report=False,
        assets=True,
        variants=("night",),
    )
    made = make_sequence(asked, library.root, "a-1")
    assert made.num_bytes > 0
    plain = rows(library, "sightings", kind="actor", run_id=made.run_id)
    styled = rows(library, kind="actor", style="night:1")
    assert {row["derived_from"] for row in styled} == {row["asset_id"] for row in plain}
    assert all(row["psnr_db"] is None and row["score"] > 0 for row in styled)
    twice = [row for row in rows(library, kind="actor", style=None) if row["num_sightings"] == 2]
    assert twice  # in both runs of the scene
    tables = [library.tables.rows(table) for table in ("assets", "sightings")]
    assert make_sequence(asked, library.root, "a-2").num_bytes == 0
    assert [library.tables.rows(table) for table in ("assets", "sightings")] == tables
    succeed("catalog", "delete", made.run_id, "--yes", store=library)
    assert {row["num_sightings"] for row in rows(library, kind="actor", style=None)} == {1}
