"""The doctor writes what it found, of a stored scene and of a dataset as downloaded."""

import json
import shutil

import pytest
from toy_store import TOY_SCENE, write_toy_scene
from toy_street import ToyStreet

from catalog.store import open_store
from tasks.ingest import data_checks
from tasks.ingest.data_checks import check_dataset, check_stored_scene


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    store = open_store(tmp_path_factory.mktemp("store"))
    write_toy_scene(store.root)
    return store


def test_stored_scene_gets_a_verdict_per_check_a_image_and_a_json(store):
    findings = check_stored_scene(store, TOY_SCENE, None)
    names = [finding.name for finding in findings]
    assert {"ego poses", "camera sync", "camera calibration", "licence", "overlay"} <= set(names)
    image = next(finding.detail for finding in findings if finding.name == "overlay")
    report = json.loads((store.root / "doctor" / f"{TOY_SCENE}.json").read_text())
    assert image == str(store.root / "doctor" / f"{TOY_SCENE}.png")
    assert report["scene"] == TOY_SCENE
    assert [found["name"] for found in report["findings"]] == names[:-1]
    assert report["is_fit"] == all(found["verdict"] != "fail" for found in report["findings"])


def test_the_overlay_shows_an_image_that_is_there(tmp_path):
    street = ToyStreet(num_frames=3)
    street.views = tuple(view for view in street.views if view.frame_index != 1)
    assert data_checks._write_overlay(street, tmp_path / "overlay.png").stat().st_size > 1_000


def test_dataset_on_disk_is_examined_sequence_by_sequence(store, tmp_path):
    source = store.scene_folder(TOY_SCENE)
    for name in ("sound", "broken"):
        shutil.copytree(source, tmp_path / "root" / name)
    (tmp_path / "root/broken/boxes.parquet").write_bytes(b"PAR1")
    findings = check_dataset(store, "canonical", tmp_path / "root", tmp_path / "out")
    verdicts = {finding.name: finding.verdict for finding in findings}
    assert verdicts["broken: reading"] == "fail"
    assert verdicts["sound: stored content"] == "ok"
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["sound.json", "sound.png"]
