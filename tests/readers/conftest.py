"""What tests of several readers share: a street, and a copy of a log that is free to be damaged."""

import pytest
from av2_log import street_like_av2


@pytest.fixture(scope="session")
def street(tmp_path_factory):
    """The truth: three sweeps of a LiDAR that takes its time, two cameras, far from the origin."""
    return street_like_av2(tmp_path_factory.mktemp("street"))


@pytest.fixture
def log(sound_log, tmp_path):
    """The reader's sound log, free to be changed."""
    return sound_log.copied(tmp_path / "log")


@pytest.fixture
def store(tmp_path):
    return tmp_path / "store"
