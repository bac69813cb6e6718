"""The library answers on the command line: list, show, query, export, gallery."""

import json

import pytest
from commands import call, refuse, succeed

from lidarpainter_models.export.spz_files import read_spz
from lidarpainter_models.gaussians.model.ply_files import read_ply
from lidarpainter_models.scenes.driving_scene import DrivingScene


@pytest.fixture(scope="module")
def library(own_run):
    """A store with the assets of one run."""
    succeed("assets", "publish", own_run.run_id, store=own_run.store)
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
