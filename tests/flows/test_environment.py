import os

import pytest

from flows.environment import prepare_environment
from tasks.job_limits import usable_cores


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
