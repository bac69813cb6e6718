"""A store to be changed, and a clock to be turned on."""

import pytest
from shop import Shop


class Clock:
    now = 1000.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture(scope="package")
def first_shop(tmp_path_factory):
    return Shop(tmp_path_factory.mktemp("shop"))


@pytest.fixture
def shop(first_shop, tmp_path):
    return first_shop.copied(tmp_path)
