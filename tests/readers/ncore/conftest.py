"""A synthetic street as an NCore log, and what is read of it."""

import pytest
from ncore_log import SEQUENCE, write_ncore_log
from written_logs import WrittenLog


@pytest.fixture(scope="session")
def sound_log(street, tmp_path_factory):
    """In folders, where single records can be damaged."""
    root = tmp_path_factory.mktemp("ncore")
    write_ncore_log(street, root, store_type="directory")
    return WrittenLog("ncore", root, SEQUENCE)


@pytest.fixture(scope="session")
def read_street(sound_log, tmp_path_factory):
    return sound_log.read(tmp_path_factory.mktemp("store"))
