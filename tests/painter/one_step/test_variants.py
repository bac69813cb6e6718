"""Ablations of the one-step painter: one choice at a time, every wiring once."""

import pytest

from lidarpainter_models.painter.one_step.latent_fusion import LatentFusion
from lidarpainter_models.painter.one_step.presets import PRESETS, fast, paper
from lidarpainter_models.painter.one_step.variants import ablations, distinct


@pytest.mark.parametrize("preset", PRESETS)
def test_every_table_holds_the_wiring_itself_and_can_be_built(preset):
    config = PRESETS[preset]()
    tables = ablations(config)
    for wirings in tables.values():
        assert config in wirings.values()
        assert len(set(wirings.values())) == len(wirings) > 1
    for wiring in distinct(tables).values():
        if wiring.fusion is not None:
            LatentFusion(wiring.fusion, len(wiring.inputs))  # refuses inputs that it cannot weigh


def test_a_table_varies_one_choice():
    config = paper()
    tables = ablations(config)
    fields = {"t": "timestep", "step": "denoise", "skips": "skips", "lidar": "lidar"}
    for choice, field in fields.items():
        for wiring in tables[choice].values():
            same = {**wiring.to_dict(), field: None}
            assert same == {**config.to_dict(), field: None}
    assert tables["fusion"]["off"].fusion is None
    assert tables["fusion"]["off"].inputs == config.inputs


def test_a_wiring_that_stands_in_several_tables_is_trained_once():
    tables = ablations(paper())
    wirings = distinct(tables)
    assert len(set(wirings.values())) == len(wirings)
    shared = sum(len(table) for table in tables.values()) - len(wirings)
    assert shared == len(tables) - 1


def test_the_tiny_autoencoder_has_no_table_of_skips():
    assert "skips" not in ablations(fast())
