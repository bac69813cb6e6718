"""Harvests as stages: their pairs survive a kill and lie in a folder that commands take."""

from types import SimpleNamespace

import pytest
from random_pairs import random_pair
from toy_store import TOY_SCENE, write_toy_scene

from catalog.store import open_store
from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.synthetic import SyntheticStreetConfig
from lidarpainter_models.training_data.settings import HarvestConfig
from tasks.ingest import ingest
from tasks.painter import harvest
from tasks.specs import SplitSpec

SPLIT = SplitSpec(scene_id=TOY_SCENE, spec="alternate")


@pytest.fixture
def store(tmp_path):
    store = open_store(tmp_path / "store")
    write_toy_scene(store.root)
    return store


def writing(number, *, fails=False):
    """A stand-in for the fits of a harvest: pairs that are there are not written again."""
    added = []

    def harvest_left_out(scene, split, plans, writer, *, config, progress):
        assert isinstance(config, HarvestConfig)
        assert set(split.train_frames) >= {frame for plan in plans for frame in plan.fit_frames}
        for index in range(number):
            if f"p{index}" not in writer:
                provenance = {"dataset": scene.dataset, "target": [index // 2, "front"]}
                writer.add(f"p{index}", random_pair(index), provenance)
                added.append(index)
            progress(index + 1, number)
        if fails:
            raise KeyboardInterrupt

    return harvest_left_out, added


def test_pairs_of_a_killed_harvest_are_kept(store, monkeypatch):
    killed, _ = writing(2, fails=True)
    monkeypatch.setattr(harvest, "harvest_left_out", killed)
    with pytest.raises(KeyboardInterrupt):
        harvest.harvest_recorded.fn(store.root, "harvest", SPLIT, HarvestConfig())
    going_on, added = writing(4)
    monkeypatch.setattr(harvest, "harvest_left_out", going_on)
    made = harvest.harvest_recorded.fn(store.root, "harvest", SPLIT, HarvestConfig())
    assert added == [2, 3]
    assert made.summary["num_pairs"] == 4
    assert made.summary["num_targets"] == 2
    assert len(harvest.pair_set(store, "toy", made.ref).open()) == 4
    monkeypatch.setattr(harvest, "harvest_left_out", pytest.fail)
    again = harvest.harvest_recorded.fn(store.root, "harvest", SPLIT, HarvestConfig())
    assert not again.is_new
    assert store.artefacts.verified(again.ref)


def test_a_harvest_without_a_pair_is_one_clear_line(store, monkeypatch):
    monkeypatch.setattr(harvest, "harvest_left_out", writing(0)[0])
    with pytest.raises(DataError, match="no view could be made into a pair"):
        harvest.harvest_recorded.fn(store.root, "harvest toy", SPLIT, HarvestConfig())
    assert store.tables.rows("artefacts") == []


def test_a_street_is_drawn_only_if_the_store_has_none_of_its_seed(store, monkeypatch):
    drawn = []
    monkeypatch.setattr(harvest.ingest_street, "fn", lambda _store, config: drawn.append(config))
    config = SyntheticStreetConfig(seed=1000)
    assert harvest.keep_street.fn(store.root, config) == "synthetic/street-1000"
    assert drawn == [config]

    generator = {"config": config.to_dict(), "world_version": ingest.WORLD_VERSION}
    stored = SimpleNamespace(manifest={"generator": generator})
    monkeypatch.setattr(ingest, "open_scene", lambda _store, _scene_id: stored)
    harvest.keep_street.fn(store.root, config)
    assert drawn == [config]
    with pytest.raises(ConfigError, match="street-1000 is in the store with other frames"):
        harvest.keep_street.fn(store.root, SyntheticStreetConfig(seed=1000, num_frames=5))
    generator["world_version"] -= 1
    harvest.keep_street.fn(store.root, config)
    assert drawn == [config, config]
