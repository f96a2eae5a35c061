import pytest

from l3r.launch.expand import expand
from tests.launch.sweeps import write_sweep_file


@pytest.fixture
def sweep(tmp_path):
    """Two rows, three seeds, beside the paper's table of lambda."""
    rows = {"0.01": "loss.global_weight=0.01", "0.1": []}
    path = write_sweep_file(tmp_path, rows=rows, seeds=[0, 1, 2], table="global_weight")
    return expand(path)
