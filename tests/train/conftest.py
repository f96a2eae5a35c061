import os

import pytest
import torch

from tests.data.graphs import make_graph, write_folder


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """Sums of many threads differ in the last bit, and equal losses are what is tested here."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"
    yield
    del os.environ["OMP_NUM_THREADS"]
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def hand_shards(tmp_path_factory):
    """Eight graphs of three 16 x 16 images."""
    folder = tmp_path_factory.mktemp("hand")
    graphs = [make_graph(n, num_views=3, height=16, width=16) for n in range(8)]
    return write_folder(folder, graphs)
