"""A run's assets: published once, found, put into another scene, and gone with the run."""

import pytest
import torch
from commands import call, refuse, succeed
from tiny_street import SCENE, SETTINGS

from flows.fleet.asked_sequences import Asked
from flows.fleet.work import make_sequence
from lidarpainter_models.assets.asset_files import read_asset
from lidarpainter_models.serving.refusals import RequestError
from tasks.runs import open_run
from tasks.serving.library import StoredActors
from tasks.stored import load_scene


@pytest.fixture(scope="module")
def published(own_run):
    return succeed("assets", "publish", own_run.run_id, "--json", store=own_run.store).json


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


def test_an_actor_of_the_library_drives_in_a_scene(own_run, published):  # noqa: ARG001
    store, asset = own_run.store, best_actor(own_run.store)
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


def test_a_server_takes_the_actor_that_is_nearest_in_class_and_size(own_run, published):  # noqa: ARG001
    actors, best = StoredActors(own_run.store), best_actor(own_run.store)
    model = actors.model(best[:8])
    assert set(actors.names) == {
        row["asset_id"] for row in rows(own_run.store, kind="actor", style=None)
    }
    found = actors.model(actors.nearest(model.category, model.size_m))
    assert torch.allclose(found.size_m, model.size_m)
    assert actors.nearest("zeppelin", None) in actors.names  # of no such class: of all
    with pytest.raises(RequestError, match="asset 'zebra': no asset 'zebra'"):
        actors.model("zebra")


@pytest.mark.parametrize(
    ("source", "complaint"),
    [
        ("asset:zebra", "no asset 'zebra'"),
        ("asset:", "source.asset: String should have at least 1 character"),
        ("zebra", "source: Input should be"),
    ],
)
def test_an_asset_that_cannot_be_put_in_is_one_line(own_run, published, source, complaint):  # noqa: ARG001
    words = ("edit", own_run.run_id, "insert", "guest", f"source={source}")
    refused = call(*words, store=own_run.store)
    assert refused.code == 2
    assert complaint in refused.err
    assert refused.err.count("\n") == 1


def test_streets_are_not_put_in_like_actors(own_run, published):  # noqa: ARG001
    street = rows(own_run.store, kind="street")[0]["asset_id"]
    words = ("edit", own_run.run_id, "insert", "guest", f"source.asset={street}")
    assert "is a street, expected an actor" in call(*words, store=own_run.store).err


def test_a_fleet_publishes_a_scene_and_its_variants(own_run, published):  # noqa: ARG001
    """Observations and the first fit are those of the run that is there."""
    store = own_run.store
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
    made = make_sequence(asked, store.root, "a-1")
    assert made.num_bytes > 0
    plain = rows(store, "sightings", kind="actor", run_id=made.run_id)
    styled = rows(store, kind="actor", style="night:1")
    assert {row["derived_from"] for row in styled} == {row["asset_id"] for row in plain}
    assert all(row["psnr_db"] is None and row["score"] > 0 for row in styled)
    twice = [row for row in rows(store, kind="actor", style=None) if row["num_sightings"] == 2]
    assert twice  # in both runs of the scene
    tables = [store.tables.rows(table) for table in ("assets", "sightings")]
    assert make_sequence(asked, store.root, "a-2").num_bytes == 0
    assert [store.tables.rows(table) for table in ("assets", "sightings")] == tables
    succeed("catalog", "delete", made.run_id, "--yes", store=store)
    assert {row["num_sightings"] for row in rows(store, kind="actor", style=None)} == {1}
