"""Damaged PandaSet logs and canonical scenes are refused with one line or become sound scenes."""

import gzip
import os
import shutil

import numpy as np
import pytest
from fuzzing import MAX_MEMORY_BYTES, fuzz, judge, peak_bytes
from mutations import damaged_bytes, damaged_json
from pickled_tables import pickled_table

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers import ingest_scene

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


def any_file(log, files):
    """Chooses a file of a log and damages it."""

    def damage(rng):
        file = log / files[rng.integers(len(files))]
        return file, damaged(file.read_bytes(), file.name, rng)

    return damage


def fuzz_pandaset(sound, sandbox, seeds):
    """Damage the files of a log that an ingest with the options `FEW` opens."""
    root = sandbox / "root"
    shutil.copytree(sound, root / sound.name)
    files = [
        file.relative_to(sound)
        for file in sorted(sound.rglob("*"))
        if file.is_file() and not file.name.startswith("02.")
    ]
    cameras = [f"camera/{name}/" for name in FEW["cameras"]]
    files = [
        file
        for file in files
        if file.parts[0] != "camera" or file.as_posix().startswith(tuple(cameras))
    ]
    return fuzz(
        lambda store: ingest_scene("pandaset", root, sound.name, store, **FEW),
        any_file(root / sound.name, files),
        seeds,
        sandbox=sandbox,
        named=(str(root / sound.name),),
    )


def fuzz_canonical(sound, sandbox, seeds):
    """Damage any file of a scene folder."""
    root = sandbox / "root"
    shutil.copytree(sound, root / sound.name)
    files = sorted(file.relative_to(sound) for file in sound.rglob("*") if file.is_file())
    return fuzz(
        lambda store: ingest_scene("canonical", root, sound.name, store),
        any_file(root / sound.name, files),
        seeds,
        sandbox=sandbox,
        named=(str(root / sound.name),),
    )


@pytest.fixture(scope="module")
def sound_scene(small_scene):
    return small_scene.path


def test_damaged_log_is_refused_or_sound(sound_pandaset, tmp_path):
    outcomes = fuzz_pandaset(sound_pandaset.path, tmp_path, range(NUM_FAST))
    assert outcomes.total() == NUM_FAST
    assert outcomes["refused"] > 0


def test_damaged_scene_is_refused_or_sound(sound_scene, tmp_path):
    outcomes = fuzz_canonical(sound_scene, tmp_path, range(NUM_FAST))
    assert outcomes["refused"] > NUM_FAST / 2


@pytest.mark.slow
def test_ten_thousand_damaged_logs(sound_pandaset, tmp_path):
    outcomes = fuzz_pandaset(sound_pandaset.path, tmp_path, range(NUM_ALL))
    assert outcomes["refused"] + outcomes["accepted"] == NUM_ALL
    assert peak_bytes() < MAX_MEMORY_BYTES


@pytest.mark.slow
def test_ten_thousand_damaged_scenes(sound_scene, tmp_path):
    outcomes = fuzz_canonical(sound_scene, tmp_path, range(NUM_ALL))
    assert outcomes["refused"] + outcomes["accepted"] == NUM_ALL
    assert peak_bytes() < MAX_MEMORY_BYTES


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


def test_image_that_states_more_than_it_may_is_refused(pandaset, tmp_path):
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
