import pytest
from gaussian_world import build_world


@pytest.fixture(scope="session")
def world():
    return build_world()
