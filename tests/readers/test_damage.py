"""The damage that readers are tried with is real, seeded, and judged strictly."""

import json
import time
from collections import Counter

import fuzzing
import numpy as np
import pytest
from fuzzing import judge
from mutations import damaged_bytes, damaged_json

from lidarpainter_models.errors import DataError
from lidarpainter_models.scenes.driving_scene import DrivingScene

ROWS = [{"token": f"{i:032x}", "next": f"{i + 1:032x}", "at": [0.5, i]} for i in range(8)]


def test_equal_seeds_give_equal_damage():
    content = json.dumps(ROWS).encode()
    for damage in (damaged_bytes, damaged_json):
        first, again = (
            [damage(content, np.random.default_rng(seed)).content for seed in range(50)]
            for _ in range(2)
        )
        assert first == again
        assert len({*first}) > 40


@pytest.mark.parametrize("content", [b"", b"x", b"\x00" * 100])
def test_any_bytes_can_be_damaged(content):
    rng = np.random.default_rng(0)
    changed = sum(damaged_bytes(content, rng).content != content for _ in range(200))
    assert changed > (20 if content else 0)


@pytest.mark.parametrize("value", [[], {}, None, 3, "x", {"a": [1, {"b": "c"}]}])
def test_any_json_can_be_damaged(value):
    rng = np.random.default_rng(0)
    ways = Counter(damaged_json(json.dumps(value).encode(), rng).description for _ in range(300))
    assert len(ways) > 20


def judged(ingest, tmp_path):
    return judge(ingest, store=tmp_path / "store", sandbox=tmp_path, named=("log/poses.json",))


def test_refusal_with_a_place_is_a_good_end(tmp_path):
    def refuse():
        raise DataError("log/poses.json, frame 3: x is nan, expected a finite number")

    assert judged(refuse, tmp_path).outcome == "refused"


def test_scene_is_a_good_end_and_its_faults_are_told(small_scene, sound_pandaset, tmp_path):
    verdict = judged(lambda: sound_pandaset.ingest(tmp_path / "store"), tmp_path)
    assert verdict.error is None
    assert isinstance(small_scene, DrivingScene)
    assert verdict.outcome in ("accepted", "found by the doctor")


def test_other_ends_are_not_good(tmp_path):
    def crash():
        raise KeyError("token")

    def name_nothing():
        raise DataError("x is nan")

    def leave_a_file():
        (tmp_path / "store").mkdir()
        (tmp_path / "store/half").write_text("written")
        raise DataError("log/poses.json: cut off")

    def write_elsewhere():
        (tmp_path / "elsewhere").write_text("written")
        raise DataError("log/poses.json: cut off")

    with pytest.raises(KeyError):
        judged(crash, tmp_path)
    for ingest, complaint in (
        (name_nothing, "no place is named"),
        (write_elsewhere, "outside the store"),
        (leave_a_file, "a refused log left"),
    ):
        with pytest.raises(AssertionError, match=complaint):
            judged(ingest, tmp_path)


def test_ingest_without_end_is_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(fuzzing, "MAX_SECONDS", 0.1)

    def spin():
        while True:
            pass

    def wait():
        time.sleep(60)

    for ingest, complaint in ((spin, "s of CPU time"), (wait, "s of waiting")):
        with pytest.raises(AssertionError, match=complaint):
            judged(ingest, tmp_path)
