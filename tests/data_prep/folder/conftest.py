"""Scenes that several tests read and none changes."""

import pytest

from tests.data_prep.folder.writers import PARAMS, write_colmap_scene


@pytest.fixture(scope="session")
def colmap_scenes(tmp_path_factory):
    """A folder of one scene for each lens, and what was written into it."""
    root = tmp_path_factory.mktemp("colmap")
    return root, {name: write_colmap_scene(root / name.lower(), name) for name in PARAMS}
