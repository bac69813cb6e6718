"""Damaged PandaSet logs and canonical scenes are refused with one line or become sound scenes."""

import gzip
import os
import shutil
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mutations import damaged_bytes, damaged_json, judge
from pickled_tables import pickled_table

from lidarpainter_models.errors import DataError
from lidarpainter_models.scenes.readers import ingest_scene

NUM_FAST, NUM_ALL = 8, 10_000
# Python's own unpickling of texts warns of what a damaged one holds
pytestmark = pytest.mark.filterwarnings("ignore:invalid escape sequence:DeprecationWarning")
FEW = {"frames": slice(0, 2), "cameras": ("front_camera", "back_camera")}


def damaged(content, name, rng):
    """A damaged file: its JSON values, the pickle inside its gzip, or plain bytes."""
    if name.endswith(".json"):
        return damaged_json(content, rng)
    if name.endswith(".gz") and rng.random() < 0.7:
        inside = damaged_bytes(gzip.decompress(content), rng)
        return type(inside)(gzip.compress(inside.content, 1), f"unzipped, {inside.description}")
    return damaged_bytes(content, rng)


def is_read(file):
    """Whether an ingest with the options `FEW` opens a file of the log."""
    camera = file.parts[1] if file.parts[0] == "camera" else None
    return not file.name.startswith("02.") and camera in (None, *FEW["cameras"])


def fuzz(dataset, sound, seeds, **options):
    """Damage one file per seed; counts how the ingests ended."""
    files = sorted(path.relative_to(sound) for path in sound.rglob("*") if path.is_file())
    if dataset == "pandaset":
        files = [file for file in files if is_read(file)]
    outcomes = Counter()
    with tempfile.TemporaryDirectory() as sandbox:
        root = Path(sandbox, "root")
        shutil.copytree(sound, root / sound.name)
        for seed in seeds:
            rng = np.random.default_rng(seed)
            file = files[rng.integers(len(files))]
            content = (sound / file).read_bytes()
            damage = damaged(content, file.name, rng)
            (root / sound.name / file).write_bytes(damage.content)
            store = Path(sandbox, "store")
            try:
                verdict = judge(
                    lambda: ingest_scene(dataset, root, sound.name, store, **options),  # noqa: B023
                    store=store,
                    sandbox=sandbox,
                    named=(str(root / sound.name), f"{dataset}/{sound.name}"),
                )
            except BaseException as error:
                error.add_note(f"seed {seed}: {file}: {damage.description}")
                raise
            outcomes[verdict.outcome] += 1
            (root / sound.name / file).write_bytes(content)
            shutil.rmtree(store, ignore_errors=True)
    return outcomes


@pytest.fixture(scope="module")
def sound_scene(small_scene):
    return small_scene.path


def test_damaged_log_is_refused_or_sound(sound_pandaset):
    outcomes = fuzz("pandaset", sound_pandaset.path, range(NUM_FAST), **FEW)
    assert outcomes.total() == NUM_FAST
    assert outcomes["refused"] > 0


def test_damaged_scene_is_refused_or_sound(sound_scene):
    outcomes = fuzz("canonical", sound_scene, range(NUM_FAST))
    assert outcomes["refused"] > NUM_FAST / 2


@pytest.mark.slow
def test_ten_thousand_damaged_logs(sound_pandaset):
    assert fuzz("pandaset", sound_pandaset.path, range(NUM_ALL), **FEW).total() == NUM_ALL


@pytest.mark.slow
def test_ten_thousand_damaged_scenes(sound_scene):
    assert fuzz("canonical", sound_scene, range(NUM_ALL)).total() == NUM_ALL


def refused_table(log, content, tmp_path):
    log.write("lidar/00.pkl.gz", gzip.compress(content, 1))
    store = tmp_path / "store"
    verdict = judge(
        lambda: log.ingest(store), store=store, sandbox=tmp_path, named=("lidar/00.pkl.gz",)
    )
    assert verdict.outcome == "refused"
    return verdict.error


def test_gzip_bomb_is_refused(pandaset, tmp_path):
    assert "unpacks to more than" in refused_table(pandaset, bytes(80_000_000), tmp_path)


def test_pickle_of_endless_marks_is_refused_soon(pandaset, tmp_path):
    program = b"\x80\x03" + b"(" * 600_000 + b"t" * 600_000 + b"."
    assert "more than 100000 opcodes" in refused_table(pandaset, program, tmp_path)


def test_deep_tuple_as_a_key_is_refused_before_it_is_hashed(pandaset, tmp_path):
    program = b"\x80\x03}N" + b"\x85" * 90_000 + b"Ns."
    assert "a key is neither" in refused_table(pandaset, program, tmp_path)


def test_table_of_too_many_rows_is_refused(pandaset, tmp_path):
    columns = {name: np.zeros(1_000_001, dtype=np.int8) for name in "xyzitd"}
    message = refused_table(pandaset, pickled_table(columns), tmp_path)
    assert "1000001 rows, expected at most 1000000" in message


def test_picture_that_states_more_than_it_may_is_refused(pandaset, tmp_path):
    file = pandaset.path / "camera/front_camera/00.jpg"
    content = bytearray(file.read_bytes())
    start = content.index(b"\xff\xc0") + 5
    content[start : start + 4] = b"\xff\xff\xff\xff"
    file.write_bytes(content)
    with pytest.raises(ValueError, match="states 65535 x 65535 px"):
        pandaset.ingest(tmp_path / "store")


def test_pipe_in_the_place_of_a_file_is_refused(pandaset, tmp_path):
    file = pandaset.path / "lidar/00.pkl.gz"
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(ValueError, match="not a file"):
        pandaset.ingest(tmp_path / "store")


def test_time_beyond_all_nanoseconds_is_refused(pandaset, tmp_path):
    pandaset.write("lidar/timestamps.json", b"[1e308, 1.0, 2.0]")
    with pytest.raises(DataError, match=r"timestamps.json: expected a list of times in seconds"):
        pandaset.ingest(tmp_path / "store")
