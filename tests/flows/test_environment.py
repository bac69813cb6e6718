import os

import pytest

from flows.environment import prepare_environment, usable_cores


@pytest.fixture
def bare_environment(monkeypatch):
    """No thread counts set; what is set meanwhile is taken back."""
    for name in list(os.environ):
        if name.endswith("_NUM_THREADS"):
            monkeypatch.delenv(name)
    monkeypatch.setattr(os, "environ", dict(os.environ))


@pytest.mark.usefixtures("bare_environment")
@pytest.mark.parametrize("at_once", [1, 2, 1000])
def test_sequences_that_run_at_once_share_the_cores(at_once):
    prepare_environment(is_quiet=True, sequences_at_once=at_once)
    threads = int(os.environ["NUMBA_NUM_THREADS"])
    assert os.environ["OMP_NUM_THREADS"] == str(threads)
    assert threads == max(usable_cores() // at_once, 1)


@pytest.mark.usefixtures("bare_environment")
def test_thread_count_of_the_user_stays():
    os.environ["NUMBA_NUM_THREADS"] = "7"
    prepare_environment(is_quiet=True, sequences_at_once=2)
    assert os.environ["NUMBA_NUM_THREADS"] == "7"


@pytest.mark.parametrize(
    ("limit", "cores"), [("50000 100000", 1), ("100000 100000", 1), ("max 100000", None)]
)
def test_quota_of_a_container_counts_as_cores(tmp_path, limit, cores):
    path = tmp_path / "cpu.max"
    path.write_text(limit)
    unlimited = usable_cores(tmp_path / "absent")
    assert usable_cores(path) == (unlimited if cores is None else cores)
