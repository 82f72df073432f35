"""Sets that several files of tests train on."""

import pytest

from helpers.learning_sets import write_fake_splits
from tactip_twin.learning.data import read_splits


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_fake_splits(tmp_path_factory.mktemp("sets") / "surface", samples=48)


@pytest.fixture(scope="module")
def splits(data):
    return read_splits(data)
