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
def test_threads_follow_the_usable_cores():
    prepare_environment()
    assert os.environ["NUMBA_NUM_THREADS"] == os.environ["OMP_NUM_THREADS"] == str(usable_cores())


@pytest.mark.usefixtures("bare_environment")
def test_thread_count_of_the_user_stays():
    os.environ["NUMBA_NUM_THREADS"] = "7"
    prepare_environment()
    assert os.environ["NUMBA_NUM_THREADS"] == "7"


@pytest.mark.parametrize(
    ("limit", "cores"), [("50000 100000", 1), ("100000 100000", 1), ("max 100000", None)]
)
def test_quota_of_a_container_counts_as_cores(tmp_path, limit, cores):
    path = tmp_path / "cpu.max"
    path.write_text(limit)
    unlimited = usable_cores(tmp_path / "absent")
    assert usable_cores(path) == (unlimited if cores is None else cores)
