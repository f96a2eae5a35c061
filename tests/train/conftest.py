import pytest

from tests.data.graphs import make_graph, write_folder


@pytest.fixture(scope="session")
def hand_shards(tmp_path_factory):
    """Eight graphs of three 16 x 16 images."""
    folder = tmp_path_factory.mktemp("hand")
    graphs = [make_graph(n, num_views=3, height=16, width=16) for n in range(8)]
    return write_folder(folder, graphs)
