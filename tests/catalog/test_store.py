"""A store is one folder, and names never lead out of it."""

from datetime import UTC, datetime

import pytest

from catalog.errors import CatalogError, UnknownRecordError
from catalog.records import RunRecord, metric_row, run_id_of
from catalog.store import STORE_ENVIRONMENT, open_store


def run_record(run_id="r1", **changes):
    values = {
        "run_id": run_id,
        "scene_id": "synthetic/street-0001",
        "scene_digest": "d",
        "preset": "preview",
        "painter": "none",
        "parameters": "{}",
        "source_digest": "s",
        "software_version": "0.1.0",
        "started_at": datetime(2026, 1, 1, tzinfo=UTC),
        "device": "cpu",
    }
    return RunRecord(**{**values, **changes})


def test_a_given_path_wins_over_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv(STORE_ENVIRONMENT, str(tmp_path / "environment"))
    assert open_store(tmp_path / "given").root == tmp_path / "given"
    assert open_store().root == tmp_path / "environment"
    monkeypatch.delenv(STORE_ENVIRONMENT)
    monkeypatch.chdir(tmp_path)
    assert open_store().root == tmp_path / "lidarpainter-store"


def test_a_file_in_the_place_of_the_store_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CatalogError, match="is a file, expected a folder"):
        open_store(tmp_path / "file")


def test_a_name_that_no_folder_can_have_is_refused(tmp_path):
    with pytest.raises(CatalogError, match="cannot be there: File name too long"):
        open_store(tmp_path / ("s" * 300))


@pytest.mark.parametrize("name", ["a%2Fb", "a%20b", "tab\tin", "new\nline", "back\\slash"])
def test_a_path_that_tables_cannot_have_is_refused_before_anything_is_written(tmp_path, name):
    with pytest.raises(CatalogError, match="in a path, choose a folder without it"):
        open_store(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["my drives", "100%", "a#b", "what?", "köln-通り", "br[0]{x}*"])
def test_a_path_of_other_odd_letters_holds_tables(tmp_path, name):
    store = open_store(tmp_path / name)
    store.tables.merge("runs", [run_record().row()])
    assert open_store(tmp_path / name).run("r1")["scene_id"] == "synthetic/street-0001"


def test_looking_into_a_store_that_is_not_there_makes_nothing(tmp_path):
    store = open_store(tmp_path / "store")
    assert store.tables.rows("scenes") == []
    with pytest.raises(UnknownRecordError):
        store.tables.row("runs", "a")
    assert not store.root.exists()


@pytest.mark.parametrize(
    "scene_id", ["pandaset", "pandaset/../../etc", "../x", "a/b/c", "a/", "/a", "a/.b", ""]
)
def test_scene_ids_cannot_leave_the_store(tmp_path, scene_id):
    with pytest.raises(UnknownRecordError, match="no scene id"):
        open_store(tmp_path).scene_folder(scene_id)


def test_a_scene_has_its_folder(tmp_path):
    folder = open_store(tmp_path).scene_folder("pandaset/002")
    assert folder == tmp_path / "scenes" / "pandaset" / "002"


def test_latest_is_the_run_that_completed_last(tmp_path):
    store = open_store(tmp_path)
    with pytest.raises(UnknownRecordError, match="no complete run"):
        store.run("latest")
    records = [
        run_record("early", status="complete", finished_at=datetime(2026, 1, 2, tzinfo=UTC)),
        run_record("late", status="complete", finished_at=datetime(2026, 1, 3, tzinfo=UTC)),
        run_record("newest-but-running"),
    ]
    store.tables.merge("runs", [record.row() for record in records])
    assert store.run("latest")["run_id"] == "late"
    assert store.run("ear")["seconds"] == 86_400.0
    assert store.run(records[0].scene_id)["run_id"] == "late"
    with pytest.raises(UnknownRecordError, match="no complete run of other/scene in"):
        store.run("other/scene")


def test_run_ids_follow_content_parameters_and_source():
    ids = {
        run_id_of("scene", {"steps": 1}, "source"),
        run_id_of("scene", {"steps": 1}, "other"),
        run_id_of("scene", {"steps": 2}, "source"),
        run_id_of("other", {"steps": 1}, "source"),
    }
    assert len(ids) == 4
    assert run_id_of("scene", {"steps": 1}, "source") in ids


def test_a_metric_has_one_id_per_place_and_variant():
    def row(**changes):
        values = {
            "run_id": "r",
            "scene_id": "s",
            "protocol": "truth",
            "trajectory": "left-2m",
            "variant": "painted",
            "name": "psnr",
            "value": 21.5,
        }
        return metric_row(**{**values, **changes})

    assert row(value=3.0)["metric_id"] == row()["metric_id"]
    assert row(variant="unpainted")["metric_id"] != row()["metric_id"]
