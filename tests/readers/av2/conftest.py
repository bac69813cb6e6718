"""A synthetic street as an Argoverse 2 log, and what is read of it."""

import pytest
from av2_log import LOG, write_av2_log
from written_logs import WrittenLog


@pytest.fixture(scope="session")
def sound_log(street, tmp_path_factory):
    root = tmp_path_factory.mktemp("av2")
    write_av2_log(street, root)
    return WrittenLog("av2", root, LOG)


@pytest.fixture(scope="session")
def read_street(sound_log, tmp_path_factory):
    return sound_log.read(tmp_path_factory.mktemp("store"))
