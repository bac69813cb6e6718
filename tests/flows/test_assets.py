"""A run's assets: published once, found, put into another scene, and gone with the run."""

import pytest
from commands import succeed

from lidarpainter_models.assets.asset_files import read_asset


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
