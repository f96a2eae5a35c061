"""A real two-node SLURM on this machine, and what tests do with it."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Self

from tests.slurm.daemons import NODES, Daemons, end_leftovers
from tests.slurm.programs import SEARCH_PATH

ROOT = Path(__file__).resolve().parents[2]
FINAL = {
    *("BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "NODE_FAIL"),
    *("OUT_OF_MEMORY", "PREEMPTED", "TIMEOUT"),
}
"""States that a job leaves by a requeue only."""


class ClusterError(AssertionError):
    """The cluster does not do what a test waits for; the message has the logs."""


class SlurmCluster:
    """Nodes ``n1`` and ``n2`` of two CPUs and 8000 MB each, in partition ``main``.

    Their names do not resolve: a job's master address must be set to 127.0.0.1. Jobs find this
    Python and its scripts in PATH and the code under test in PYTHONPATH.

    Attributes:
        env: Environment in which SLURM's programs speak to this cluster.
        folder: Configuration and logs.
    """

    def __init__(self) -> None:
        self._daemons = Daemons()
        self.folder = self._daemons.folder
        path = os.pathsep.join([str(Path(sys.executable).parent), SEARCH_PATH])
        self.env = {
            **self._daemons.env,
            "PATH": path,
            "PYTHONPATH": str(ROOT),
            "OMP_NUM_THREADS": "1",
        }

    def __enter__(self) -> Self:
        """End what killed runs have left, then start the daemons."""
        end_leftovers()
        try:
            self._daemons.start()
            self.wait_idle()
        except BaseException:
            self._daemons.end()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """End every daemon and every process of every job."""
        self._daemons.end()

    def sbatch(
        self,
        script: Path | str,
        *args: str,
        cwd: Path,
        env: Mapping[str, str] | None = None,
        **options: str | int | bool,
    ) -> str:
        """Submit a script.

        Args:
            script: A file, or the text of one.
            args: Arguments of the script.
            cwd: Folder to submit in; relative output files appear there.
            env: Variables to set beside ``self.env``.
            options: Of sbatch: ``cpus_per_task=2`` is ``--cpus-per-task=2``, True a bare switch.

        Returns:
            The job's id; a task of an array is ``ID_TASK``.
        """
        if isinstance(script, str):
            path = cwd / "job.sh"
            path.write_text(script)
            script = path
        flags = [
            f"--{key.replace('_', '-')}" + ("" if value is True else f"={value}")
            for key, value in options.items()
        ]
        command = ["sbatch", "--parsable", *flags, str(script), *args]
        return self.run(*command, cwd=cwd, env=env).strip()

    def run(
        self, *command: str, cwd: Path | None = None, env: Mapping[str, str] | None = None
    ) -> str:
        """Run one of SLURM's programs and give what it prints.

        Raises:
            ClusterError: It fails.
        """
        done = subprocess.run(
            command,
            env={**self.env, **(env or {})},
            cwd=cwd or self.folder,
            capture_output=True,
            text=True,
            timeout=120,
        )
        if done.returncode:
            raise ClusterError(f"{' '.join(command)}: {done.stderr.strip()}")
        return done.stdout

    def states(self, job: str) -> list[str]:
        """Give the state of a job, or of every task of an array."""
        return self.run("squeue", "-h", "-r", "-t", "all", "-j", job, "-o", "%T").split()

    def wait(self, job: str, state: str = "COMPLETED", timeout: float = 60) -> None:
        """Wait until a job, or every task of an array, is in a state.

        Raises:
            ClusterError: It takes too long, or the job has ended otherwise.
        """

        def arrived() -> bool:
            states = self.states(job)
            lost = [found for found in states if found in FINAL - {state}]
            if lost:
                raise ClusterError(f"job {job} is {', '.join(states)}\n{self._report(job)}")
            return bool(states) and set(states) == {state}

        self._poll(arrived, timeout, lambda: f"job {job} is not {state}\n{self._report(job)}")

    def wait_output(self, job: str, text: str, timeout: float = 60) -> None:
        """Wait until a job has written a text; a job that is RUNNING may not have begun to.

        Raises:
            ClusterError: It takes too long.
        """
        self._poll(
            lambda: text in self.output(job),
            timeout,
            lambda: f"job {job} has not written '{text}'\n{self._report(job)}",
        )

    def requeue(self, job: str) -> None:
        """Send a job back to the queue; it waits two minutes there, or for ``release``."""
        self.run("scontrol", "requeue", job)

    def release(self, job: str) -> None:
        """Let a requeued job start at once."""
        self._poll(
            lambda: set(self.states(job)) == {"PENDING"},
            60,
            lambda: f"job {job} does not come back to the queue\n{self._report(job)}",
        )
        # A node refuses a job that starts in the very second in which it was killed there.
        time.sleep(2)
        self.run("scontrol", "update", f"jobid={job}", "StartTime=now")

    def cancel(self, job: str) -> None:
        """Cancel a job."""
        self.run("scancel", job)

    def signal(self, job: str, name: str) -> None:
        """Send a signal, such as ``USR1``, to all steps of a job, or to one (``ID.0``).

        The batch shell gets none. ``KILL`` to a whole job cancels it.
        """
        self.run("scancel", f"--signal={name}", job)

    def output(self, job: str) -> str:
        """Give what a job, or every task of an array, has written to its output file."""
        records = self.run("scontrol", "-o", "show", "job", job).splitlines()
        words = [word for record in records for word in record.split()]
        paths = [Path(word[7:]) for word in words if word.startswith("StdOut=")]
        return "".join(path.read_text(errors="replace") for path in paths if path.is_file())

    def kill_node(self, name: str) -> None:
        """Take a node away, as a power cut would, and let the controller know at once."""
        self._daemons.kill_node(name)
        self.run("scontrol", "update", f"nodename={name}", "state=DOWN", "reason=killed")

    def restore_node(self, name: str) -> None:
        """Give a node back, if it was taken."""
        if not self._daemons.is_running(name):
            self._daemons.start_node(name)
            self.run("scontrol", "update", f"nodename={name}", "state=RESUME")
        self.wait_idle()

    def reset(self) -> None:
        """Cancel all jobs and give back all nodes."""
        for job in set(self.run("squeue", "-h", "-o", "%A").split()):
            self.run("scancel", "--full", "--signal=KILL", job)
            self.run("scancel", job)
        for node in NODES:
            self.restore_node(node)

    def wait_idle(self, timeout: float = 60) -> None:
        """Wait until both nodes answer and nothing runs on them."""

        def idle() -> bool:
            try:
                found = self.run("sinfo", "-h", "-N", "-o", "%N %T").split()
            except ClusterError:
                return False
            return found == [word for node in NODES for word in (node, "idle")]

        self._poll(idle, timeout, lambda: f"the nodes are not idle\n{self._daemons.logs()}")

    def _report(self, job: str) -> str:
        queue = self.run("squeue", "-r", "-t", "all", "-j", job)
        return f"{queue}--- output\n{self.output(job)}\n{self._daemons.logs()}"

    @staticmethod
    def _poll(arrived: Callable[[], bool], timeout: float, complaint: Callable[[], str]) -> None:
        deadline = time.monotonic() + timeout
        while not arrived():
            if time.monotonic() > deadline:
                raise ClusterError(f"after {timeout:g} s {complaint()}")
            time.sleep(0.2)
