"""One cluster for all tests that need one."""

import pytest

from tests.slurm.cluster import SlurmCluster
from tests.slurm.programs import provide_programs


@pytest.fixture(scope="session")
def live_cluster():
    """The running cluster; tests take ``cluster``."""
    reason = provide_programs()
    if reason:
        pytest.skip(f"needs SLURM: {reason}")
    with SlurmCluster() as running:
        yield running


@pytest.fixture
def cluster(live_cluster):
    """The cluster with both nodes idle; jobs that a test leaves are cancelled."""
    yield live_cluster
    live_cluster.reset()
