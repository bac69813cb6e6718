"""Every benchmark runs to its end in its smallest form, as its own text says to call it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from written_logs import WRITERS

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


def run(name, *words):
    """Run a script beside this one; what it printed."""
    paths = os.pathsep.join(map(str, (ROOT, ROOT / "tests" / "support")))
    done = subprocess.run(
        [sys.executable, HERE / name, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": paths},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def slow(*case):
    return pytest.param(*case, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("name", "words", "told"),
    [
        ("bench_serving.py", ("--quick",), "fisheye of 190 degrees:"),
        ("bench_one_step.py", ("costs", "--size", "64x64"), "{"),
        slow("bench_length.py", ("--quick",), "... over"),
    ],
)
def test_a_benchmark_that_makes_its_own_input_tells_figures(name, words, told):
    assert told in run(name, *words)


def test_ingest_is_timed_and_its_digests_are_one(tmp_path):
    log = WRITERS["pandaset"](tmp_path)
    words = ("--dataset", log.dataset, "--sequence", log.sequence, "--runs", "2")
    assert run("bench_ingest.py", log.root, *words).count("frames/s") == 2


@pytest.mark.slow
def test_a_long_log_is_written(tmp_path):
    assert "synthetic/whole-log: 5 images" in run("whole_log.py", tmp_path, "--frames", "1")
