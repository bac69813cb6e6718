"""One small street, served on a real socket for all tests of the room."""

import pytest
from served_street import ServedStreet, served

from lidarpainter_models.serving import wire


@pytest.fixture(scope="session")
def street(tmp_path_factory):
    return ServedStreet(tmp_path_factory.mktemp("served"))


@pytest.fixture(scope="session")
def channel(street):
    with served(street) as channel:
        yield channel


@pytest.fixture
def client(channel):
    return wire.client(channel)


@pytest.fixture(scope="session")
def view(street):
    """A recorded view in the middle of the drive."""
    return street.recording.views_of("front_camera")[2]
