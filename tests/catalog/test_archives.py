"""What is exported comes back as it was; what others wrote is not believed."""

import io
import json
import tarfile

import pytest

from catalog.archives import ARCHIVE_MANIFEST, select, write_archive
from catalog.errors import CatalogError, DamagedArtefactError, UnknownRecordError
from catalog.imports import ArchiveError, import_archive
from catalog.store import open_store

TABLES = ("scenes", "artefacts", "painters", "metrics", "runs")


@pytest.fixture(scope="module")
def shop(first_shop, tmp_path_factory):
    made = first_shop.copied(tmp_path_factory.mktemp("shop"))
    for run in made.store.tables.rows("runs"):
        made.change("runs", run["run_id"], result=json.dumps({"artefacts": {}}))
    return made


def exported(shop, out, *names):
    rows = [("runs", shop.store.row("runs", name)) for name in names]
    chosen = select(shop.store, rows)
    write_archive(shop.store, chosen, out)
    return out


@pytest.fixture(scope="module")
def archive(shop, tmp_path_factory):
    return exported(shop, tmp_path_factory.mktemp("out") / "r1.tar", "r1")


def contents(store):
    folders = ("artefacts", "scenes")
    paths = [path for folder in folders for path in (store.root / folder).rglob("*")]
    files = {path.relative_to(store.root): path.read_bytes() for path in paths if path.is_file()}
    return files, {table: store.tables.rows(table) for table in TABLES}


def test_a_run_comes_with_all_that_it_needs_and_nothing_else(shop, archive, tmp_path):
    store = open_store(tmp_path / "store")
    counts = import_archive(store, archive)
    assert counts == {"scenes": 1, "artefacts": 2, "painters": 0, "metrics": 1, "runs": 1}
    files, rows = contents(store)
    there, all_rows = contents(shop.store)
    assert files.items() <= there.items()
    assert {str(path).split("/")[1] for path in files} == {"fit", "first", "toy"}
    for table in TABLES:
        assert all(row in all_rows[table] for row in rows[table])
    assert store.artefacts.verified(shop.first)
    assert set(import_archive(store, archive).values()) == {0}
    assert contents(store) == (files, rows)
    assert not list((store.root / "aside").iterdir())


def test_an_export_is_the_same_twice(shop, archive, tmp_path):
    assert exported(shop, tmp_path / "again.tar", "r1").read_bytes() == archive.read_bytes()


def test_another_scene_of_that_name_is_kept(archive, tmp_path):
    store = open_store(tmp_path / "store")
    folder = store.root / "scenes/toy/street"
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text('{"content_digest": "ours"}')
    with pytest.raises(ArchiveError, match=r"toy/street is in .* with another content"):
        import_archive(store, archive)
    assert not (store.root / "artefacts").exists()


def test_what_is_damaged_or_not_a_run_is_not_exported(shop, tmp_path):
    own = shop.copied(tmp_path)
    data = own.store.artefacts.folder(own.fit) / "data"
    data.write_bytes(b"x" * 1000)
    with pytest.raises(DamagedArtefactError, match="is not what was written"):
        exported(own, tmp_path / "r1.tar", "r1")
    with pytest.raises(UnknownRecordError, match="metrics are not exported"):
        select(own.store, [("metrics", {})])
    own.change("runs", "r1", status="failed")
    with pytest.raises(CatalogError, match="run r1 is not complete"):
        exported(own, tmp_path / "r1.tar", "r1")
    assert not (tmp_path / "r1.tar").exists()


class Forged:
    """An archive that can be written otherwise than it was."""

    def __init__(self, archive):
        with tarfile.open(archive) as tar:
            self.entries = [(entry, tar.extractfile(entry).read()) for entry in tar]

    @property
    def manifest(self):
        return json.loads(self.entries[0][1])

    def with_manifest(self, change):
        manifest = self.manifest
        change(manifest)
        content = json.dumps(manifest).encode()
        self.entries[0] = (self.entry(ARCHIVE_MANIFEST, len(content)), content)

    def entry(self, name, size=0, kind=tarfile.REGTYPE, target=""):
        made = tarfile.TarInfo(name)
        made.size, made.type, made.linkname = size, kind, target
        return made

    def name_of(self, end):
        return next(entry.name for entry, _ in self.entries if entry.name.endswith(end))

    def rename(self, old, new):
        self.with_manifest(lambda found: found["files"].update({new: found["files"].pop(old)}))
        for entry, _ in self.entries:
            entry.name = new if entry.name == old else entry.name

    def replace(self, old, entry, content=b""):
        names = [one.name for one, _ in self.entries]
        self.entries[names.index(old)] = (entry, content)

    def write(self, path):
        with tarfile.open(path, "w", format=tarfile.PAX_FORMAT) as tar:
            for entry, content in self.entries:
                tar.addfile(entry, io.BytesIO(content))
        return path


def changed_row(table, **values):
    return lambda forged: forged.with_manifest(lambda found: found["rows"][table][0].update(values))


def renamed(new):
    return lambda forged: forged.rename(forged.name_of("data"), new)


def retyped(kind, target=""):
    def change(forged):
        name = forged.name_of("data")
        forged.replace(name, forged.entry(name, kind=kind, target=target))

    return change


def with_content(content, *, declared=False):
    def change(forged):
        name = forged.name_of("data")
        forged.replace(name, forged.entry(name, len(content)), content)
        if declared:
            size = {"num_bytes": len(content)}
            forged.with_manifest(lambda found: found["files"][name].update(size))

    return change


def without_last(forged):
    forged.entries.pop()


def with_more(forged):
    forged.entries.append((forged.entry("artefacts/fit/more/data"), b""))


def twice(forged):
    forged.entries.append(forged.entries[-1])


def of_tomorrow(forged):
    forged.with_manifest(lambda found: found.update(version=2))


def of_size(value):
    def change(forged):
        name = forged.name_of("data")
        forged.with_manifest(lambda found: found["files"][name].update(num_bytes=value))

    return change


def with_row_again(table, **values):
    def change(found):
        found["rows"][table].append({**found["rows"][table][0], **values})

    return lambda forged: forged.with_manifest(change)


def with_other_digest(forged):
    old = next(name for name in forged.manifest["files"] if name.startswith("artefacts/fit"))
    digest = old.split("/")[2]
    for name in list(forged.manifest["files"]):
        if digest in name:
            forged.rename(name, name.replace(digest, "0" * 32))


FORGERIES = {
    "up": (renamed("artefacts/fit/../../../../x"), "is no file of a store"),
    "absolute": (renamed("/etc/cron.d/x"), "is no file of a store"),
    "hidden": (renamed("artefacts/fit/.ssh/x"), "is no file of a store"),
    "tables": (renamed("tables/runs/_delta_log/0.json"), "is no file of a store"),
    "long": (renamed("artefacts/fit/a/" + "b" * 600), "is no file of a store"),
    "symlink": (retyped(tarfile.SYMTYPE, "/etc/passwd"), "was not declared as a file"),
    "hard link": (retyped(tarfile.LNKTYPE, "/etc/passwd"), "was not declared as a file"),
    "device": (retyped(tarfile.CHRTYPE), "was not declared as a file"),
    "pipe": (retyped(tarfile.FIFOTYPE), "was not declared as a file"),
    "longer": (with_content(b"-" * 2000), "of another size than was declared"),
    "other bytes": (with_content(b"x" * 1000), "is not what was written"),
    "bomb": (of_size(10**18), "bytes are free|bytes, .* are free"),
    "no size": (of_size(float("nan")), "has no size or digest"),
    "endless": (of_size(float("inf")), "has no size or digest"),
    "missing": (without_last, "is missing"),
    "undeclared": (with_more, "was not declared"),
    "twice": (twice, "was not declared"),
    "newer": (of_tomorrow, "a newer lidarpainter wrote it"),
    "other digest": (with_other_digest, "is not what its name says|damaged"),
    "other code": (changed_row("runs", artefacts=["fit/" + "1" * 32]), "neither in it nor in"),
    "run up": (changed_row("runs", artefacts=["../x"]), "'../x' is no artefact"),
    "result up": (
        changed_row("runs", result='{"artefacts": {"fit": "../../etc"}}'),
        "'../../etc' is no artefact",
    ),
    "report up": (changed_row("runs", report="../../../etc/passwd"), "report leads out"),
    "report root": (changed_row("runs", report="/etc/passwd"), "report leads out"),
    "running": (changed_row("runs", status="running"), "a run is not complete"),
    "scene up": (changed_row("scenes", scene_id="../x"), "is no scene id"),
    "phantom": (with_row_again("scenes", scene_id="toy/other"), "toy/other is not in it"),
    "row twice": (with_row_again("runs"), "share a run_id"),
    "column": (changed_row("scenes", colour="red"), "scenes has no column 'colour'"),
    "type": (changed_row("scenes", num_frames="many"), "its manifest cannot be used"),
    "time": (changed_row("artefacts", created_at="soon"), "its manifest cannot be used"),
}


def test_a_run_that_lists_no_artefacts_is_taken(archive, tmp_path):
    forged = Forged(archive)
    changed_row("runs", artefacts=[])(forged)
    store = open_store(tmp_path / "store")
    assert import_archive(store, forged.write(tmp_path / "forged.tar"))["runs"] == 1


@pytest.mark.parametrize(("forge", "expected"), FORGERIES.values(), ids=FORGERIES)
def test_a_forged_archive_is_refused_in_one_line_and_leaves_nothing(
    archive, tmp_path, forge, expected
):
    forged = Forged(archive)
    forge(forged)
    store = open_store(tmp_path / "inside" / "store")
    with pytest.raises(ArchiveError, match=expected) as caught:
        import_archive(store, forged.write(tmp_path / "forged.tar"))
    assert "\n" not in str(caught.value)
    left = {path.relative_to(store.root) for path in store.root.rglob("*")}
    assert {str(path) for path in left} <= {"aside", "locks", "locks/import.lock"}
    assert {path.name for path in tmp_path.iterdir()} == {"inside", "forged.tar"}


@pytest.mark.parametrize("content", [b"", b"\0" * 10240, b"PK\3\4" * 100])
def test_what_is_no_archive_is_said_to_be_none(tmp_path, content):
    path = tmp_path / "x.tar"
    path.write_bytes(content)
    with pytest.raises(ArchiveError, match="is no archive of lidarpainter"):
        import_archive(open_store(tmp_path / "store"), path)
    with pytest.raises(ArchiveError, match="no archive"):
        import_archive(open_store(tmp_path / "store"), tmp_path / "none.tar")
