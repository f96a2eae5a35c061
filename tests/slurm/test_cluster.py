"""The house itself: what jobs may count on, and that nothing stays behind."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.slurm.cluster import ROOT, ClusterError, SlurmCluster
from tests.slurm.daemons import end_leftovers
from tests.slurm.processes import find_processes

pytestmark = pytest.mark.slurm

CATCH = """\
import signal, sys, time
def stop(number, frame):
    print("got", signal.Signals(number).name, flush=True)
    sys.exit(0)
signal.signal(signal.SIGUSR1, stop)
print("ready", flush=True)
time.sleep(600)
"""
LAST = "#!/usr/bin/env bash\nsrun bash -c 'echo up; exec sleep 600'\n"


def test_a_step_runs_on_both_nodes_with_this_python_and_the_code_under_test(cluster, tmp_path):
    (tmp_path / "say.py").write_text(
        "import os, sys, l3r; print(os.environ['SLURMD_NODENAME'], sys.prefix, l3r.__file__)"
    )
    script = "#!/usr/bin/env bash\nsrun python say.py\n"
    job = cluster.sbatch(script, cwd=tmp_path, nodes=2, ntasks_per_node=1)
    cluster.wait(job)
    said = [line.split() for line in sorted(cluster.output(job).splitlines())]
    assert said == [[node, sys.prefix, str(ROOT / "l3r/__init__.py")] for node in ("n1", "n2")]


def test_an_array_runs_every_task_with_its_arguments(cluster, tmp_path):
    script = '#!/usr/bin/env bash\necho "$SLURM_ARRAY_TASK_ID $*"\n'
    job = cluster.sbatch(script, "two words", "3", cwd=tmp_path, array="1-4", job_name="tasks")
    cluster.wait(job)
    assert sorted(cluster.output(job).splitlines()) == [f"{i} two words 3" for i in range(1, 5)]
    assert cluster.output(f"{job}_2") == "2 two words 3\n"


def test_a_requeued_job_starts_again_once_it_is_released(cluster, tmp_path):
    script = (
        '#!/usr/bin/env bash\necho "run ${SLURM_RESTART_COUNT:-0}"\n'
        '[ "${SLURM_RESTART_COUNT:-0}" = 1 ] || sleep 600\n'
    )
    job = cluster.sbatch(script, cwd=tmp_path, requeue=True, open_mode="append")
    cluster.wait_output(job, "run 0")
    cluster.requeue(job)
    cluster.release(job)
    cluster.wait(job)
    assert "run 0" in cluster.output(job)
    assert cluster.output(job).endswith("run 1\n")


def test_a_signal_to_a_job_reaches_python(cluster, tmp_path):
    (tmp_path / "catch.py").write_text(CATCH)
    job = cluster.sbatch("#!/usr/bin/env bash\nsrun python catch.py\n", cwd=tmp_path)
    cluster.wait_output(job, "ready")
    cluster.signal(job, "USR1")
    cluster.wait(job)
    assert "got SIGUSR1" in cluster.output(job)


def test_the_warning_before_the_time_limit_reaches_python(cluster, tmp_path):
    (tmp_path / "catch.py").write_text(CATCH)
    script = "#!/usr/bin/env bash\nsrun python catch.py\n"
    # The controller looks twice a minute: the signal comes between 10 and 40 s from the start.
    job = cluster.sbatch(script, cwd=tmp_path, time=2, signal="USR1@80")
    cluster.wait(job, timeout=100)
    assert "got SIGUSR1" in cluster.output(job)


def test_a_job_whose_node_goes_away_starts_again_elsewhere(cluster, tmp_path):
    script = (
        '#!/usr/bin/env bash\necho "run on $SLURMD_NODENAME"\n'
        '[ "$SLURMD_NODENAME" = n2 ] || exec srun sleep 600\n'
    )
    job = cluster.sbatch(script, cwd=tmp_path, requeue=True, open_mode="append")
    cluster.wait_output(job, "run on n1")
    cluster.kill_node("n1")
    assert not find_processes(cluster.folder, "n1")
    cluster.release(job)
    cluster.wait(job)
    assert cluster.output(job).endswith("run on n2\n")
    cluster.restore_node("n1")


def test_a_job_that_fails_is_reported_with_its_output(cluster, tmp_path):
    job = cluster.sbatch("#!/usr/bin/env bash\necho so it was\nexit 3\n", cwd=tmp_path)
    with pytest.raises(ClusterError, match="FAILED") as caught:
        cluster.wait(job)
    assert "so it was" in str(caught.value)


def test_a_second_cluster_stands_beside_the_first_and_leaves_nothing(cluster, tmp_path):
    with SlurmCluster() as second:
        second.wait_output(second.sbatch(LAST, cwd=tmp_path), "up\n")
        names = {_name(pid) for pid in find_processes(second.folder)}
        assert {"munged", "slurmctld", "slurmd", "slurmstepd", "sleep"} <= names
    assert not find_processes(second.folder)
    assert not second.folder.exists()
    cluster.wait_idle()


def test_what_a_killed_run_leaves_is_ended_by_the_next(cluster, tmp_path):
    code = (
        "import sys, time\nfrom pathlib import Path\n"
        "from tests.slurm.cluster import SlurmCluster\n"
        "with SlurmCluster() as running:\n"
        "    job = running.sbatch(sys.argv[1], cwd=Path(sys.argv[2]))\n"
        "    running.wait_output(job, 'up')\n"
        "    print(running.folder, flush=True)\n"
        "    time.sleep(600)\n"
    )
    run = subprocess.Popen(
        [sys.executable, "-c", code, LAST, str(tmp_path)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
    )
    folder = Path(run.stdout.readline().strip())
    run.send_signal(signal.SIGKILL)
    run.wait()
    assert "slurmstepd" in {_name(pid) for pid in find_processes(folder)}
    end_leftovers()
    assert not find_processes(folder)
    assert not folder.exists()
    assert cluster.folder.exists()
    cluster.wait_idle()


def _name(pid):
    return Path(f"/proc/{pid}/comm").read_text().strip()
