"""Every damage is named, and nothing else."""

from catalog.verification import verify


def damage(shop, check_scene=lambda _folder: None):
    found = list(verify(shop.store, check_scene))
    assert len({one.name for one in found}) == len(found)
    return {one.name: one.damage for one in found if one.damage}


def test_a_whole_store_has_no_damage(shop):
    assert damage(shop) == {}


def test_one_flipped_bit_is_found(shop):
    file = shop.store.artefacts.folder(shop.fit) / "data"
    content = bytearray(file.read_bytes())
    content[500] ^= 1
    file.write_bytes(content)
    assert list(damage(shop)) == [shop.fit.artefact_id]
    assert "data is not what was written" in damage(shop)[shop.fit.artefact_id]


def test_what_is_missing_unreadable_or_without_a_row_is_named(shop):
    root = shop.store.root
    (shop.store.artefacts.folder(shop.fit) / "data").unlink()
    (shop.store.artefacts.folder(shop.first) / "manifest.json").write_text("{")
    shop.store.artefacts.folder(shop.second).rename(root / "artefacts/second/elsewhere")
    assert set(damage(shop)) == {
        shop.fit.artefact_id,
        shop.first.artefact_id,
        shop.second.artefact_id,
        "second/elsewhere",
    }


def test_what_a_scene_is_found_to_have_is_passed_on(shop):
    asked = []

    def check(folder):
        asked.append(folder)
        return "the first image is damaged"

    assert damage(shop, check) == {"scene toy/street": "the first image is damaged"}
    assert asked == [shop.store.scene_folder("toy/street")]


def test_a_damaged_table_is_named_and_the_rest_is_read_all_the_same(shop):
    for file in (shop.store.root / "tables/metrics").glob("*.parquet"):
        file.write_bytes(b"PAR1" + b"x" * 100)
    assert list(damage(shop)) == ["table metrics"]
