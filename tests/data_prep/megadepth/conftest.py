"""A reconstruction that several tests read and none changes."""

import pytest

from tests.data_prep.megadepth.writers import write_merged


@pytest.fixture(scope="session")
def merged(tmp_path_factory):
    """One reconstruction in the merged layout, and what was written."""
    root = tmp_path_factory.mktemp("merged")
    return root, write_merged(root, "0001")
