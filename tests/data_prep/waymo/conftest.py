"""A short recorded drive and its files in both versions."""

import pytest

from data_prep.converters.waymo import read
from data_prep.problems import Problems
from tests.data_prep.waymo import drive
from tests.data_prep.waymo.parquet_writer import write_v2
from tests.data_prep.waymo.wire_writer import write_v1

NUM_FRAMES = 3


@pytest.fixture(scope="session")
def segment():
    """What the sensors recorded; not to be changed."""
    return drive.record(NUM_FRAMES)


@pytest.fixture(scope="session")
def light():
    """The same with few laser beams, for tests that write many files; not to be changed."""
    few = dict.fromkeys(drive.LASER_SIZES, (6, 30))
    return drive.record(NUM_FRAMES, {**few, 1: (6, 120)})


@pytest.fixture(scope="session")
def roots(tmp_path_factory, segment):
    """A root of each kind; not to be written to."""
    root = tmp_path_factory.mktemp("waymo")
    write_v1(root / "v1" / "training", segment)
    write_v2(root / "v2" / "training", segment)
    write_v2(root / "v2_old" / "training", segment, old=True, row_group_size=4)
    return {kind: root / kind for kind in ("v1", "v2", "v2_old")}


@pytest.fixture(scope="session")
def scene(roots):
    """The scene of version 1."""
    return read_one(roots["v1"])


def read_one(root, **options):
    """Read the only scene below a root, which must be sound."""
    problems = Problems()
    (scene,) = read(root, problems=problems, **options)
    assert problems.summary() == "none"
    return scene
