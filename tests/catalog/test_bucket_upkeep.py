"""Collecting, verifying, exporting and importing where the store is a bucket."""

import json
import os
from datetime import UTC, datetime, timedelta

import pytest
from shop import Shop

from catalog import collection
from catalog.archives import select, write_archive
from catalog.collection import plan_collection
from catalog.deletion import delete
from catalog.imports import ArchiveError, import_archive
from catalog.leases import Leases
from catalog.store import open_store
from catalog.verification import verify

LATER = datetime.now(UTC) + timedelta(days=1)


@pytest.fixture
def shop(address, tmp_path):
    made = Shop(tmp_path, address)
    for run in made.store.tables.rows("runs"):
        made.change("runs", run["run_id"], result=json.dumps({"artefacts": {}}))
    return made


def going(store, since=LATER):
    return {one.row_id for one in plan_collection(store, since) if one.table == "leftovers"}


def damage(store):
    return {one.name: one.damage for one in verify(store, pytest.fail) if one.damage}


def spoil(bucket, name, change):
    content, version = bucket.read(name)
    bucket.write(name, change(content), replacing=version)


def test_files_that_no_listing_names_and_leases_of_nobody_are_found(shop, monkeypatch):
    store, bucket = shop.store, shop.store.mirror.bucket
    killed, unfinished = "artefacts/fit/killed/0a0a", f"{shop.fit.entry}/0b0b"
    bucket.write(f"{killed}/data", b"12345", replacing=None)
    bucket.write(f"{unfinished}/deep/data", b"123", replacing=None)
    leases = Leases(store.objects("leases"))
    assert leases.give_back(leases.take("s1", above=0, facts={}))
    assert going(store, LATER - timedelta(days=30)) == set()
    store.tables.delete("artefacts", "artefact_id", [shop.flicker.artefact_id])
    with store.run_lock("r1"):
        assert going(store) == {shop.flicker.entry}  # the rest may be of somebody who publishes now
    monkeypatch.setattr(collection, "ABANDONED_AFTER", timedelta(days=-1))
    before = bucket.sizes("")
    plan = plan_collection(store, LATER)
    assert bucket.sizes("") == before
    sizes = {one.row_id: one.num_bytes for one in plan if one.table == "leftovers"}
    flicker = store.mirror.listing(shop.flicker.entry)
    assert sizes.pop(shop.flicker.entry) == sum(flicker.sizes.values())
    assert sizes == {killed: 5, unfinished: 3, "running": 12}
    delete(store, plan)
    assert going(store) == set()
    named = [ref.entry for ref in (shop.first, shop.flicker)]
    entries = (*named, *(f"published/{entry}.json" for entry in named))
    gone = {name for name in before if name.startswith((killed, unfinished, *entries, "running/"))}
    changing = ("tables/", "locks/")
    left = {name for name in bucket.sizes("") if not name.startswith(changing)}
    assert left == {name for name in before if not name.startswith(changing)} - gone
    assert {"leases/s1"} < left


def test_what_a_killed_fetch_left_is_found(shop, address, tmp_path, monkeypatch):
    monkeypatch.setenv("LIDARPAINTER_CACHE", str(tmp_path / "elsewhere"))
    store = open_store(address)
    with monkeypatch.context() as patched:
        patched.setattr("catalog.mirrors.shutil.rmtree", lambda *_, **__: None)
        store.artefacts.manifest(shop.fit)
    (left,) = store.root.glob("aside/*")
    os.utime(left, (0, 0))
    assert going(store) == {f"aside/{left.name}"}
    delete(store, plan_collection(store, LATER))
    assert not left.exists()


def test_each_byte_in_the_bucket_is_read_whatever_the_mirror_holds(shop):
    store, bucket = shop.store, shop.store.mirror.bucket
    assert damage(store) == {}
    place = store.mirror.listing(shop.fit.entry).place
    spoil(bucket, f"{shop.fit.entry}/{place}/data", lambda content: b"+" + content[1:])
    [scene] = [name for name in bucket.sizes("scenes/toy") if name.endswith("manifest.json")]
    bucket.remove([scene])
    spoil(bucket, f"published/{shop.first.entry}.json", lambda _: b"{")
    found = damage(store)
    assert set(found) == {shop.fit.artefact_id, shop.first.artefact_id, "scene toy/street"}
    assert "not what was published" in found[shop.fit.artefact_id]
    assert "listing" in found[shop.first.artefact_id]


def test_a_run_goes_from_a_bucket_into_another(shop, address, tmp_path, monkeypatch):
    out = tmp_path / "r1.tar"
    monkeypatch.setenv("LIDARPAINTER_CACHE", str(tmp_path / "elsewhere"))
    store = open_store(address)
    write_archive(store, select(store, [("runs", store.row("runs", "r1"))]), out)
    other = open_store(f"{address}-other")
    counts = import_archive(other, out)
    assert counts == {"scenes": 1, "artefacts": 2, "painters": 0, "metrics": 1, "runs": 1}
    assert other.artefacts.ids() == {shop.fit.artefact_id, shop.first.artefact_id}
    assert other.scene_ids() == ["toy/street"]
    assert damage(other) == {}
    before = other.mirror.bucket.sizes("")
    assert set(import_archive(other, out).values()) == {0}
    assert other.mirror.bucket.sizes("") == before
    assert not list((other.root / "aside").iterdir())

    third = open_store(f"{address}-third")
    with third.scene_lock("toy/street"):
        folder = third.scene_folder("toy/street")
        folder.mkdir(parents=True)
        (folder / "manifest.json").write_text('{"content_digest": "ours"}')
    with pytest.raises(ArchiveError, match=r"toy/street is in s3://.* with another content"):
        import_archive(third, out)
    assert third.artefacts.ids() == set()
