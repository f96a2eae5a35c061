"""One cluster for all tests that need one."""

import pytest

from tests.slurm.cluster import SlurmCluster
from tests.slurm.programs import provide_programs

REASON = pytest.StashKey[str]()


@pytest.fixture(scope="session")
def live_cluster(request):
    """The running cluster; tests take ``cluster``."""
    reason = provide_programs()
    if reason:
        request.config.stash[REASON] = reason
        pytest.skip(reason)
    with SlurmCluster() as running:
        yield running


@pytest.fixture
def cluster(live_cluster):
    """The cluster with both nodes idle; jobs that a test leaves are cancelled."""
    yield live_cluster
    live_cluster.reset()


def pytest_terminal_summary(terminalreporter, config):
    """Say once why the tests above were skipped."""
    if REASON in config.stash:
        terminalreporter.write_line(f"SLURM is not tested: {config.stash[REASON]}", yellow=True)
