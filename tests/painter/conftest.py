"""Seeded conditions and pairs small enough to train on in a test."""

import pytest
import torch
from random_conditions import random_conditions
from smooth_pairs import MemoryPairs, smooth_pair
from tiny_diffusion import write_model


@pytest.fixture(autouse=True)
def _one_thread():
    """Small networks lose more than they gain by waking a second thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def make_conditions():
    return random_conditions


@pytest.fixture
def make_pair():
    return smooth_pair


@pytest.fixture
def memory_pairs():
    return MemoryPairs


@pytest.fixture(scope="session")
def model_folder(tmp_path_factory):
    """A whole small model as a user would bring it; not to be changed."""
    return write_model(tmp_path_factory.mktemp("models") / "small-turbo")
