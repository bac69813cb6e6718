"""Artefacts are whole or absent, made once, and never stale."""

import errno
import json
import os
import platform
import signal
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

import pytest

from catalog.artefacts import MANIFEST_NAME, ArtefactRef, ArtefactStore, Recipe
from catalog.code_closure import Code
from catalog.errors import CatalogError, DamagedArtefactError, StorageError, UnknownRecordError

# started as another process: computes slowly, counts how often it was asked to
WORKER = """
import sys, time
from pathlib import Path
from catalog.artefacts import ArtefactStore, Recipe
from catalog.code_closure import Code

root, seconds = Path(sys.argv[1]), float(sys.argv[2])

def build(place):
    with (root / "started.txt").open("a") as file:
        file.write("started\\n")
    (place.output / "part.bin").write_bytes(b"half")
    (place.scratch / "checkpoint.txt").write_text("step 7")
    time.sleep(seconds)
    (place.output / "whole.bin").write_bytes(b"whole")

code = Code(("a:build",), {"a": "x"})
recipe = Recipe(kind="fit", inputs={"scene": "s"}, config={"steps": 1}, code=code)
ref, computed = ArtefactStore(root).produce(recipe, build)
print(ref.digest, computed)
"""


def recipe_of(steps=1, source="x"):
    code = Code(("a:build",), {"a": source})
    return Recipe(kind="fit", inputs={"scene": "s"}, config={"steps": steps}, code=code)


def write_one(place):
    (place.output / "data.bin").write_bytes(b"12345")
    (place.output / "deep").mkdir()
    (place.output / "deep" / "more.bin").write_bytes(b"678")
    return {"num_gaussians": 3}


def start_worker(root: Path, seconds: float) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", WORKER, str(root), str(seconds)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).resolve().parents[2],
    )


def wait_for(path: Path):
    deadline = time.monotonic() + 20
    while not path.exists():
        assert time.monotonic() < deadline, f"{path} never came"
        time.sleep(0.02)


def names_left(root: Path) -> list[str]:
    return [path.name for path in root.glob("aside/*")] + [p.name for p in root.glob("work/*")]


def test_manifest_tells_what_was_made_from_what(tmp_path):
    store = ArtefactStore(tmp_path)
    ref, _ = store.produce(recipe_of(), write_one)
    manifest = store.verified(ref)
    assert manifest.inputs == {"scene": "s"}
    assert manifest.config == {"steps": 1}
    assert manifest.summary == {"num_gaussians": 3}
    assert sorted(manifest.files) == ["data.bin", "deep/more.bin"]
    assert manifest.num_bytes == 8
    assert (manifest.starts, manifest.code) == (["a:build"], {"a": "x"})
    assert manifest.source_digest == recipe_of().code.digest
    assert manifest.versions["python"] == platform.python_version()
    assert manifest.versions["numba"] == version("numba")
    assert manifest.host == platform.node()


def rewrite_manifest(store, ref, **changes):
    path = store.folder(ref) / MANIFEST_NAME
    content = json.loads(path.read_text()) | changes
    kept = {name: value for name, value in content.items() if value is not None}
    path.write_text(json.dumps(kept))


def test_a_manifest_of_the_first_version_is_read_without_what_it_lacks(tmp_path):
    store = ArtefactStore(tmp_path)
    ref, _ = store.produce(recipe_of(), write_one)
    later = dict.fromkeys(["starts", "code", "versions", "host"])
    rewrite_manifest(store, ref, manifest_version=1, **later)
    assert store.verified(ref).versions == {}
    assert store.find(recipe_of()) == ref


def test_a_manifest_of_a_later_version_is_refused_and_not_overwritten(tmp_path):
    store = ArtefactStore(tmp_path)
    ref, _ = store.produce(recipe_of(), write_one)
    rewrite_manifest(store, ref, manifest_version=99, meaning="unknown")
    with pytest.raises(CatalogError, match="by a newer lidarpainter"):
        store.produce(recipe_of(), pytest.fail)


@pytest.mark.parametrize("changed", [recipe_of(steps=2), recipe_of(source="y")])
def test_another_config_or_source_is_another_artefact(tmp_path, changed):
    store = ArtefactStore(tmp_path)
    first, _ = store.produce(recipe_of(), write_one)
    second, computed = store.produce(changed, write_one)
    assert computed
    assert second.digest != first.digest


def test_a_failing_stage_leaves_nothing_but_its_scratch(tmp_path):
    def fail(place):
        (place.output / "half.bin").write_bytes(b"1")
        (place.scratch / "checkpoint.txt").write_text("step 3")
        raise RuntimeError("diverged")

    store = ArtefactStore(tmp_path)
    with pytest.raises(RuntimeError, match="diverged"):
        store.produce(recipe_of(), fail)
    assert store.find(recipe_of()) is None
    assert list((tmp_path / "aside").iterdir()) == []

    def resume(place):
        assert (place.scratch / "checkpoint.txt").read_text() == "step 3"
        write_one(place)

    assert store.produce(recipe_of(), resume)[1]
    assert names_left(tmp_path) == []


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES])
def test_a_disk_that_cannot_be_written_is_one_clear_error(tmp_path, code):
    def full(place):
        (place.output / "half.bin").write_bytes(b"1")
        raise OSError(code, os.strerror(code))

    with pytest.raises(StorageError, match="cannot store fit/"):
        ArtefactStore(tmp_path).produce(recipe_of(), full)
    assert list((tmp_path / "aside").iterdir()) == []


def test_a_full_disk_is_recognised_behind_another_languages_error(tmp_path):
    def full(_place):
        raise ValueError("I/O error: No space left on device (os error 28)")

    with pytest.raises(StorageError, match="no space left"):
        ArtefactStore(tmp_path).produce(recipe_of(), full)


def test_a_flipped_bit_is_found_on_reading(tmp_path):
    store = ArtefactStore(tmp_path)
    ref, _ = store.produce(recipe_of(), write_one)
    (store.folder(ref) / "data.bin").write_bytes(b"12344")
    with pytest.raises(DamagedArtefactError, match=r"data\.bin is not what was written"):
        store.verified(ref)


@pytest.mark.parametrize("damage", ["cut", "lost", "manifest"])
def test_a_damaged_artefact_is_made_again(tmp_path, damage):
    store = ArtefactStore(tmp_path)
    ref, _ = store.produce(recipe_of(), write_one)
    if damage == "cut":
        (store.folder(ref) / "data.bin").write_bytes(b"1")
    elif damage == "lost":
        (store.folder(ref) / "data.bin").unlink()
    else:
        (store.folder(ref) / "manifest.json").write_text("{")
    again, computed = store.produce(recipe_of(), write_one)
    assert computed
    assert again == ref
    store.verified(again)


def test_an_absent_artefact_is_named(tmp_path):
    store = ArtefactStore(tmp_path)
    with pytest.raises(UnknownRecordError, match="no fit artefact"):
        store.verified(ArtefactRef("fit", "0" * 32))


def test_of_two_processes_at_once_one_computes(tmp_path):
    workers = [start_worker(tmp_path, 0.6) for _ in range(2)]
    answers = [worker.communicate(timeout=30)[0].split() for worker in workers]
    assert answers[0][0] == answers[1][0]
    assert sorted(answer[1] for answer in answers) == ["False", "True"]
    assert (tmp_path / "started.txt").read_text().count("started") == 1


def test_a_killed_process_leaves_no_artefact_and_the_next_one_completes(tmp_path):
    killed = start_worker(tmp_path, 60)
    wait_for(tmp_path / "work" / recipe_of().digest / "checkpoint.txt")
    waiting = start_worker(tmp_path, 0)
    time.sleep(0.5)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    digest, computed = waiting.communicate(timeout=30)[0].split()
    assert computed == "True"
    folder = tmp_path / "artefacts" / "fit" / digest
    assert (folder / "whole.bin").read_bytes() == b"whole"
    assert json.loads((folder / "manifest.json").read_text())["kind"] == "fit"
    assert names_left(tmp_path) == []
