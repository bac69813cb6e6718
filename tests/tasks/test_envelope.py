"""The stage of the envelope is anchored on held-out frames of its log, and keyed on which."""

import json
from dataclasses import replace

import pytest
from toy_store import small_parameters, write_toy_scene

from catalog.store import open_store
from lidarpainter_models.evaluation.anchoring import calibration_of
from lidarpainter_models.evaluation.view_confidence import BUNDLED
from tasks.evaluation.envelope import find_envelope, load_envelope
from tasks.ingest.ingest import record_scene
from tasks.reconstruction.fit import fit
from tasks.reconstruction.prepare import prepare
from tasks.specs import FittedRef

NUM_FRAMES = 8


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Envelopes of one fit by their split: its own, another, and nothing held out."""
    store = open_store(tmp_path_factory.mktemp("store"))
    record_scene(store, write_toy_scene(store.root, NUM_FRAMES))
    parameters = small_parameters()
    run = parameters.run_spec(store.root)
    seen = prepare.fn(run, parameters.observation).ref
    fitted = FittedRef(seen, fit.fn(run, "fit", seen, parameters.fit).ref)

    def walked(spec):
        asked = replace(run, split=replace(run.split, spec=spec))
        made = find_envelope.fn(asked, fitted, parameters.evaluation_config)
        return made, load_envelope(store, made.ref)

    return {spec: walked(spec) for spec in ("alternate", "forward:4:3", "all")}


def test_what_is_promised_is_anchored_on_held_out_frames_of_the_log(found):
    _made, envelope = found["alternate"]
    assert json.loads(json.dumps(envelope)) == envelope
    said, anchored = envelope["held_out"], calibration_of(envelope)
    assert said["num_frames"] == NUM_FRAMES // 2
    assert f"anchored on {NUM_FRAMES // 2} held-out frames" in anchored.record
    moved_db = anchored.intercept_db - BUNDLED.intercept_db
    assert moved_db * said["residual_db"] > 0
    assert abs(moved_db) < abs(said["residual_db"])
    assert said["is_unlike"] == (abs(said["residual_db"]) > 3)


def test_nothing_held_out_is_not_checked(found):
    _made, envelope = found["all"]
    assert envelope["held_out"]["num_frames"] == 0
    assert calibration_of(envelope) == BUNDLED.anchored(())
    assert "not checked" in envelope["calibration"]["record"]


def test_an_envelope_is_keyed_on_which_frames_judged_it(found):
    refs = {spec: made.ref.digest for spec, (made, _envelope) in found.items()}
    assert len(set(refs.values())) == 3
    assert found["forward:4:3"][1]["held_out"]["num_frames"] == 3
