"""A synthetic street as an NCore log: read once, and copies free to be damaged."""

import pytest
from av2_log import street_like_av2
from ncore_log import SEQUENCE, write_ncore_log
from written_logs import WrittenLog


@pytest.fixture(scope="session")
def street(tmp_path_factory):
    """The truth: three sweeps, two cameras, far from the origin of their frame."""
    return street_like_av2(tmp_path_factory.mktemp("street"))


@pytest.fixture(scope="session")
def sound_log(street, tmp_path_factory):
    """In folders, where single records can be damaged."""
    root = tmp_path_factory.mktemp("ncore")
    write_ncore_log(street, root, store_type="directory")
    return WrittenLog("ncore", root, SEQUENCE)


@pytest.fixture(scope="session")
def read_street(sound_log, tmp_path_factory):
    return sound_log.read(tmp_path_factory.mktemp("store"))


@pytest.fixture
def log(sound_log, tmp_path):
    return sound_log.copied(tmp_path / "log")
