"""An explanation leads back to the scene, and names what changed."""

import json
from datetime import UTC, datetime

import pytest

from catalog.artefacts import Recipe
from catalog.code_closure import SourceTree
from catalog.errors import UnknownRecordError
from catalog.explain import Explainer
from catalog.records import RunRecord, artefact_row
from catalog.store import open_store

CODE = {
    "seen.py": "from toy.colours import colour\ndef build(place):\n    return colour(1)\n",
    "colours.py": "def colour(x):\n    return x\ndef other(x):\n    return x\n",
    "fitted.py": "def build(place):\n    return 2\n",
}


class Toy:
    """A store with a scene, and artefacts made by the code of a toy."""

    def __init__(self, root):
        self.store, self.source = open_store(root / "store"), root / "toy"
        self.source.mkdir()
        for name, text in CODE.items():
            (self.source / name).write_text(text)
        self.scene("content")

    def scene(self, digest):
        folder = self.store.scene_folder("pandaset/002")
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "manifest.json").write_text(json.dumps({"provenance": {"root": "/logs"}}))
        self.store.tables.merge("scenes", [{"scene_id": "pandaset/002", "content_digest": digest}])

    def code_today(self, starts):
        return SourceTree({"toy": self.source}).code_from(starts)

    def make(self, kind, inputs, **config):
        code = self.code_today([f"toy.{kind}:build"])
        recipe = Recipe(kind=kind, inputs=inputs, config=config, code=code)
        artefacts = self.store.artefacts
        ref, _ = artefacts.produce(recipe, lambda _place: None)
        self.store.tables.merge("artefacts", [artefact_row(ref, artefacts.manifest(ref))])
        return ref

    def explained(self, ref):
        return Explainer(self.store, self.code_today).artefact(ref)

    def change(self, name, old, new):
        path = self.source / name
        path.write_text(path.read_text().replace(old, new, 1))


@pytest.fixture
def toy(tmp_path):
    return Toy(tmp_path)


@pytest.fixture
def fitted(toy):
    seen = toy.make("seen", {"scene": "content"})
    return toy.make("fitted", {"observations": seen.digest, "painter": "warp"}, steps=3)


def test_an_artefact_leads_back_to_the_scene_and_its_files(toy, fitted):
    found = toy.explained(fitted)
    assert found.stale == ()
    assert found.facts["settings"] == {"steps": 3}
    assert found.facts["starts"] == ["toy.fitted:build"]
    assert found.facts["versions"]["python"]
    seen = found.inputs["observations"]
    assert seen.name.startswith("seen/")
    assert seen.inputs["scene"].name == "pandaset/002"
    assert seen.inputs["scene"].facts["read_from"] == {"root": "/logs"}
    assert found.inputs["painter"].name == "warp"


def test_a_comment_or_code_beside_makes_nothing_stale(toy, fitted):
    toy.change("colours.py", "def other(x):\n    return x", "def other(x):\n    return -x  # so")
    assert toy.explained(fitted).stale == ()


def test_a_changed_module_is_named_where_it_was_run_and_stale_goes_on(toy, fitted):
    toy.change("colours.py", "return x", "return x + 1")
    found = toy.explained(fitted)
    assert found.inputs["observations"].stale == ("code changed: toy.colours",)
    (reason,) = found.stale
    assert reason.startswith("input changed: observations")


def test_code_that_is_gone_is_said(toy, fitted):
    (toy.source / "fitted.py").unlink()
    (reason,) = toy.explained(fitted).stale
    assert "there is no source of toy.fitted" in reason


def test_a_scene_that_was_ingested_anew_makes_stale(toy, fitted):
    toy.scene("other content")
    (reason,) = toy.explained(fitted).inputs["observations"].stale
    assert reason == "input changed: no scene has the content content any more"


def test_the_newest_of_the_same_purpose_shows_the_setting_that_changed(toy, fitted):
    observations = toy.explained(fitted).inputs["observations"].name.partition("/")[2]
    later = toy.make("fitted", {"observations": observations, "painter": "nano"}, steps=4)
    assert toy.explained(later).newest is None
    assert toy.explained(fitted).newest == {
        "name": later.artefact_id,
        "inputs": {"painter": ["warp", "nano"]},
        "settings": {"steps": [3, 4]},
        "code": [],
    }


def test_what_one_run_made_twice_is_not_held_against_itself(toy, fitted):
    observations = toy.explained(fitted).inputs["observations"].name.partition("/")[2]
    later = toy.make("fitted", {"observations": observations, "painter": "nano"}, steps=4)
    row = {"run_id": "r1", "artefacts": [fitted.artefact_id, later.artefact_id]}
    toy.store.tables.merge("runs", [row])
    assert toy.explained(fitted).newest is None


def test_a_run_is_stale_with_any_of_its_artefacts(toy, fitted):
    now = datetime(2026, 1, 1, tzinfo=UTC)
    record = RunRecord(
        run_id="r1",
        scene_id="pandaset/002",
        scene_digest="content",
        preset="preview",
        painter="none",
        parameters='{"fit":{"steps":3}}',
        source_digest="s",
        software_version="0.1.0",
        started_at=now,
        finished_at=now,
        device="cpu",
        status="complete",
        artefacts=(fitted.artefact_id,),
    )
    toy.store.tables.merge("runs", [record.row()])
    row = toy.store.run("r1")
    found = Explainer(toy.store, toy.code_today).run(row)
    assert found.stale == ()
    assert found.verdict == "r1 is up to date: today's code would make it again as it is."
    toy.change("fitted.py", "return 2", "return 3")
    found = Explainer(toy.store, toy.code_today).run(row)
    assert found.stale == (f"{fitted.artefact_id} is stale",)
    assert found.verdict == "r1 is stale in fitted: code changed: toy.fitted."
    assert json.loads(json.dumps(found.to_dict()))["is_stale"]


def test_an_artefact_of_no_store_is_unknown(toy, fitted):
    (toy.store.artefacts.folder(fitted) / "manifest.json").unlink()
    with pytest.raises(UnknownRecordError, match="no fitted artefact"):
        toy.explained(fitted)
