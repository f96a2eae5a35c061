"""One small rendered room for all tests of data preparation."""

import pytest

from data_prep.converters.synthetic import RoomRequest, write_room
from data_prep.converters.tartanair import read
from data_prep.graph_sampling import SamplingOptions
from data_prep.problems import Problems
from data_prep.shards import BuildRequest, build_shards
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
    (scene,) = read(raw_room, scenes="*/P000", dataset="synthetic", problems=problems)
    assert not problems.counts
    return scene


@pytest.fixture(scope="session")
def room_shards(tmp_path_factory, room_scene):
    """Its shards; not to be written to."""
    out = tmp_path_factory.mktemp("shards")
    build_shards([room_scene], out, BUILD)
    return out


@pytest.fixture(scope="session")
def scattered_scene(room_scene):
    """The room with depth as lidar gives it, under a name held to the limits of such depth."""
    return scatter(room_scene, dataset="waymo")


@pytest.fixture(scope="session")
def scattered_shards(tmp_path_factory, scattered_scene):
    """Its shards; not to be written to."""
    out = tmp_path_factory.mktemp("scattered")
    build_shards([scattered_scene], out, BUILD)
    return out
