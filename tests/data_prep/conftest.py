"""One small rendered room for all tests of data preparation."""

import shutil

import pytest

from data_prep.build import build_shards
from data_prep.converters.synthetic import RoomRequest, write_room
from data_prep.graph_sampling import SamplingOptions
from data_prep.problems import Problems
from data_prep.source import HeldSource, RawSource
from data_prep.units import BuildRequest
from tests.data_prep.scattered import scatter

REQUEST = RoomRequest(num_views=24, num_held_out=4, num_walk=6, image_size=(120, 160))
BUILD = BuildRequest(
    num_graphs=5, graphs_per_shard=2, sampling=SamplingOptions(min_views=5, max_views=6)
)


@pytest.fixture(scope="session")
def raw_room(tmp_path_factory):
    """Raw layout of a room, 120x160."""
    root = tmp_path_factory.mktemp("raw")
    write_room(root, REQUEST)
    return root


@pytest.fixture(scope="session")
def room_scene(raw_room):
    """The room's training trajectory."""
    problems = Problems()
    source = RawSource(
        converter="tartanair", root=raw_room, split="all", scenes="*/P000", label="synthetic"
    )
    (scene,) = source.read(source.list_names(problems), problems)
    assert not problems.counts
    return scene


@pytest.fixture(scope="session")
def room_shards(tmp_path_factory, room_scene):
    """Its shards; not to be written to."""
    out = tmp_path_factory.mktemp("shards")
    build_shards(HeldSource([room_scene]), out, BUILD)
    return out


@pytest.fixture(scope="session")
def scattered_scene(room_scene):
    """The room with depth as lidar gives it, under a name held to the limits of such depth."""
    return scatter(room_scene, dataset="waymo")


@pytest.fixture(scope="session")
def scattered_shards(tmp_path_factory, scattered_scene):
    """Its shards; not to be written to."""
    out = tmp_path_factory.mktemp("scattered")
    build_shards(HeldSource([scattered_scene]), out, BUILD)
    return out


@pytest.fixture
def raw(raw_room, tmp_path):
    """A copy of the small held-out trajectory that a test may spoil."""
    target = tmp_path / "raw" / "room000" / "Easy" / "P001"
    shutil.copytree(raw_room / "room000" / "Easy" / "P001", target)
    return target


@pytest.fixture
def complaint(capsys):
    """Gives the one line in which a command complained; lines of progress stand beside it."""

    def read():
        lines = capsys.readouterr().err.splitlines()
        (line,) = [line for line in lines if line.startswith("l3r-prep ")]
        assert lines[-1] == line
        return line

    return read
