"""A bucket has an entry whole or not at all, whoever else writes it and whatever fails."""

import pytest

from catalog import buckets
from catalog.artefacts import Recipe
from catalog.buckets import Bucket, normal_address
from catalog.code_closure import Code
from catalog.errors import CatalogError, DamagedArtefactError, StorageError, UnreachableError
from catalog.mirrors import LIMIT_ENVIRONMENT
from catalog.store import open_store

RECIPE = Recipe(kind="fit", inputs={}, config={}, code=Code(("a:build",), {"a": "x"}))


@pytest.fixture
def machine(address, tmp_path, monkeypatch):
    """The store as another machine sees it: by a cache of its own."""

    def seen_from(name):
        monkeypatch.setenv("LIDARPAINTER_CACHE", str(tmp_path / name))
        return open_store(address)

    return seen_from


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(buckets, "RETRIES", 1)


def build_of(content):
    def build(place):
        (place.output / "data.bin").write_bytes(content)

    return build


def keys(store, below=""):
    return sorted(store.mirror.bucket.sizes(below))


def data(store, ref):
    return (store.artefacts.files(ref) / "data.bin").read_bytes()


def test_of_two_that_make_one_artefact_the_first_counts(machine):
    first, second = machine("a"), machine("b")

    def overtaken(place):
        build_of(b"second")(place)
        assert first.artefacts.produce(RECIPE, build_of(b"first"))[1]

    ref, is_new = second.artefacts.produce(RECIPE, overtaken)
    assert not is_new
    assert data(second, ref) == data(first, ref) == b"first"
    assert len(keys(second, ref.entry)) == 2  # the manifest and the data of the first alone


def test_what_was_written_before_a_lost_answer_is_known_as_ones_own(machine, stand_in):
    store = machine("a")
    stand_in.fail(after=1, only="PUT /drives/" + store.name.rpartition("/")[2] + "/published")
    ref, is_new = store.artefacts.produce(RECIPE, build_of(b"x"))
    assert is_new
    assert data(machine("b"), ref) == b"x"


def test_refusals_that_pass_are_not_noticed(machine, stand_in):
    stand_in.fail(before=40, every=3, slow_s=0.01)
    store = machine("a")
    ref, _ = store.artefacts.produce(RECIPE, build_of(b"x"))
    store.tables.merge("scenes", [{"scene_id": "a/b"}])
    assert data(machine("b"), ref) == b"x"
    assert machine("b").rows("scenes")[0]["scene_id"] == "a/b"


@pytest.mark.usefixtures("impatient")
def test_a_bucket_that_does_not_answer_is_told_in_one_line(machine, stand_in):
    store = machine("a")
    stand_in.fail(before=10**6)
    with pytest.raises(UnreachableError) as told:
        store.artefacts.produce(RECIPE, build_of(b"x"))
    assert "cannot read s3://drives/" in str(told.value)
    assert "503" in str(told.value)
    assert "\n" not in str(told.value)
    stand_in.fail(before=10**6, only="PUT")
    with pytest.raises(UnreachableError, match="cannot write s3://drives/"):
        store.artefacts.produce(RECIPE, build_of(b"x"))
    stand_in.fail()
    assert keys(store) == []
    assert store.artefacts.produce(RECIPE, build_of(b"x"))[1]


@pytest.mark.usefixtures("stand_in")
def test_a_bucket_that_is_not_there_is_named():
    with pytest.raises(StorageError, match="s3://no-such-bucket/a/tables: there is no such bucket"):
        open_store("s3://no-such-bucket/a").make()


def test_a_changed_byte_is_found_as_it_arrives(machine):
    store = machine("a")
    ref, _ = store.artefacts.produce(RECIPE, build_of(b"first"))
    (key,) = [key for key in keys(store) if key.endswith("data.bin")]
    bucket = store.mirror.bucket
    bucket.write(key, b"furst", replacing=bucket.read(key)[1])
    with pytest.raises(DamagedArtefactError, match=r"data\.bin is missing or not what was"):
        machine("b").artefacts.files(ref)


def test_what_a_bucket_has_lost_is_made_again(machine):
    store = machine("a")
    ref, _ = store.artefacts.produce(RECIPE, build_of(b"first"))
    store.mirror.bucket.remove(key for key in keys(store) if key.endswith("data.bin"))
    assert store.artefacts.find(RECIPE) is None
    assert machine("b").artefacts.produce(RECIPE, build_of(b"again")) == (ref, True)
    assert data(store, ref) == b"again"
    assert len(keys(store, ref.entry)) == 2


def test_a_listing_cannot_lead_out_of_its_entry(machine):
    store = machine("a")
    ref, _ = store.artefacts.produce(RECIPE, build_of(b"x"))
    (name,) = keys(store, "published")
    content, version = store.mirror.bucket.read(name)
    hostile = content.replace(b'"data.bin"', b'"../../../data.bin"')
    store.mirror.bucket.write(name, hostile, replacing=version)
    with pytest.raises(DamagedArtefactError, match="outside of it"):
        machine("b").artefacts.files(ref)


def test_the_cache_lets_go_of_what_is_not_in_use_and_was_not_used_for_longest(machine, monkeypatch):
    makes, reads = machine("a"), machine("b")
    recipes = [Recipe(kind=f"k{n}", inputs={}, config={}, code=RECIPE.code) for n in range(3)]
    refs = [makes.artefacts.produce(one, build_of(b"-" * 1000))[0] for one in recipes]
    monkeypatch.setenv(LIMIT_ENVIRONMENT, "4e-6")  # two of them

    def kept():
        return [one.kind for one in refs if reads.artefacts.folder(one).exists()]

    for ref in refs:
        reads.artefacts.files(ref)
    assert kept() == ["k0", "k1", "k2"]  # all are in use
    reads.release()
    reads.artefacts.files(refs[0])
    reads.mirror.tidy()
    assert kept() == ["k0", "k2"]
    assert data(reads, refs[1]) == b"-" * 1000


def test_keys_come_from_amazons_files_where_the_environment_has_none(
    machine, stand_in, tmp_path, monkeypatch
):
    lines = [f"{k.lower()} = {v}" for k, v in stand_in.environment.items() if "KEY" in k]
    (tmp_path / "keys").write_text("\n".join(["[night]", *lines]))
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "keys"))
    monkeypatch.setenv("AWS_PROFILE", "night")
    store = machine("a")
    store.tables.merge("scenes", [{"scene_id": "a/b"}])
    assert store.artefacts.produce(RECIPE, build_of(b"x"))[1]


def test_an_entry_that_another_process_lets_go_does_not_stop_tidying(machine):
    store = machine("a")
    ref, _ = store.artefacts.produce(RECIPE, build_of(b"x"))
    store.release()
    note = store.mirror.root / f"published/{ref.entry}.json"
    note.with_name("gone.json").symlink_to("nowhere")  # it is listed, and then is not there
    store.mirror.tidy()
    assert note.exists()


@pytest.mark.parametrize(
    "text", ["s3://", "s3://B/x", "s3://bucket/../x", "s3://bucket/a//b", "s3://bucket/a b"]
)
def test_what_is_no_address_is_refused(text):
    with pytest.raises(CatalogError, match="expected s3://BUCKET/PREFIX"):
        Bucket(text)


def test_an_address_survives_being_a_path(address):
    assert normal_address("s3:/bucket/a/") == normal_address("s3://bucket/a") == "s3://bucket/a"
    store = open_store(address)
    assert open_store(store.address).name == store.name == address
