"""A synthetic street as an Argoverse 2 log: read once, and a copy free to be damaged."""

import pytest
from av2_log import LOG, street_like_av2, write_av2_log
from written_logs import WrittenLog


@pytest.fixture(scope="session")
def street(tmp_path_factory):
    """The truth: three sweeps, two cameras, far from the origin of the city."""
    return street_like_av2(tmp_path_factory.mktemp("street"))


@pytest.fixture(scope="session")
def sound_log(street, tmp_path_factory):
    root = tmp_path_factory.mktemp("av2")
    write_av2_log(street, root)
    return WrittenLog("av2", root, LOG)


@pytest.fixture(scope="session")
def read_street(sound_log, tmp_path_factory):
    return sound_log.read(tmp_path_factory.mktemp("store"))


@pytest.fixture
def log(sound_log, tmp_path):
    return sound_log.copied(tmp_path / "log")
