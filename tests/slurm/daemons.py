"""The daemons of a two-node SLURM on this machine, in a folder of their own.

Configuration, ports, and munge's key and socket are the folder's own, so that a SLURM or a munge
that runs here is neither used nor disturbed. The daemons stay children of the process that starts
them and get SIGTERM from the kernel when it dies, however it dies. Job steps outlive it, as they
shall on a cluster: they are ended by ``end_leftovers`` when the next cluster starts.
"""

import contextlib
import fcntl
import getpass
import os
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
from pathlib import Path
from typing import IO

from tests.slurm.processes import end_processes, slurmd_log
from tests.slurm.programs import SEARCH_PATH

PREFIX = "light3r-slurm-"
NODES = ("n1", "n2")
_CONF = """\
ClusterName=light3r
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd-%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
MpiDefault=none
ReturnToService=2
JobRequeue=1
# Between SIGTERM and SIGKILL; and for how long finished jobs are remembered.
KillWait=5
MinJobAge=3600
SlurmdParameters=config_overrides
NodeName=n1 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[1]} CPUs=2 RealMemory=8000
NodeName=n2 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[2]} CPUs=2 RealMemory=8000
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


class Daemons:
    """munged, slurmctld and the nodes' slurmd, started and ended together."""

    def __init__(self) -> None:
        self.folder, self._lock = _claim_folder()
        host = socket.gethostname().partition(".")[0]
        conf = _CONF.format(
            folder=self.folder, host=host, user=getpass.getuser(), ports=_free_ports(3)
        )
        (self.folder / "slurm.conf").write_text(conf)
        (self.folder / "state").mkdir()
        key = self.folder / "munge.key"
        key.touch(mode=0o600)
        key.write_bytes(secrets.token_bytes(1024))
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def env(self) -> dict[str, str]:
        """This process's environment, pointed at this cluster and at no other."""
        foreign = ("SLURM", "SBATCH_", "SALLOC_", "SRUN_", "SQUEUE_", "SINFO_", "SCANCEL_")
        env = {key: value for key, value in os.environ.items() if not key.startswith(foreign)}
        return {**env, "SLURM_CONF": str(self.folder / "slurm.conf")}

    def start(self) -> None:
        """Start everything; whether it is well is the cluster's to ask."""
        files = {
            "socket": "munge.socket",
            "key-file": "munge.key",
            "pid-file": "munged.pid",
            "log-file": "munged.log",
            "seed-file": "munged.seed",
        }
        options = [f"--{option}={self.folder / name}" for option, name in files.items()]
        # Forced, as munged warns of root, who owns this folder and runs all of this cluster.
        self._start("munged", "munged", "--foreground", "--force", *options)
        self._start("slurmctld", "slurmctld", "-D")
        for node in NODES:
            self.start_node(node)

    def start_node(self, node: str) -> None:
        """Start the daemon of a node."""
        self._start(node, "slurmd", "-D", "-N", node)

    def kill_node(self, node: str) -> None:
        """Take a node away with everything that runs on it, as a power cut would."""
        self._running[node].kill()
        self._running.pop(node).wait()
        end_processes(self.folder, node)

    def is_running(self, name: str) -> bool:
        """Tell whether a daemon, named ``munged``, ``slurmctld`` or as its node, is alive."""
        return name in self._running and self._running[name].poll() is None

    def end(self) -> None:
        """End all daemons and whatever jobs have left, and remove the folder."""
        for name in [*NODES, "slurmctld", "munged"]:
            process = self._running.pop(name, None)
            if process is None:
                continue
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(timeout=10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        end_processes(self.folder)
        shutil.rmtree(self.folder)
        self._lock.close()

    def logs(self, lines: int = 25) -> str:
        """Give the end of every daemon's log."""
        paths = [self.folder / "munged.log", self.folder / "munged.out"]
        paths += [self.folder / "slurmctld.log", *(slurmd_log(self.folder, n) for n in NODES)]
        return "\n".join(
            "\n".join([f"--- {path.name}", *path.read_text(errors="replace").splitlines()[-lines:]])
            for path in paths
            if path.is_file()
        )

    def _start(self, name: str, program: str, *options: str) -> None:
        path = shutil.which(program, path=SEARCH_PATH)
        command = ["setpriv", "--pdeathsig", "TERM", str(path), *options]
        with (self.folder / f"{name}.out").open("ab") as out:
            # A session of its own: Ctrl-C is for the tests, which then end the daemons in order.
            self._running[name] = subprocess.Popen(
                command,
                env=self.env,
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                start_new_session=True,
            )


def end_leftovers() -> None:
    """End what killed runs have left, and remove their folders.

    A folder is locked while its cluster lives; one that can be locked belongs to nobody.
    """
    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        # Another run may be at the same work.
        with contextlib.suppress(FileNotFoundError, BlockingIOError):
            if folder.is_symlink() or folder.stat().st_uid != os.geteuid():
                continue
            with (folder / "lock").open("a") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                end_processes(folder)
                shutil.rmtree(folder)


def _claim_folder() -> tuple[Path, IO[str]]:
    """Make a folder and lock it before it has the name by which left-overs are found."""
    hidden = Path(tempfile.mkdtemp(prefix=f".{PREFIX}"))
    lock = (hidden / "lock").open("w")
    fcntl.flock(lock, fcntl.LOCK_EX)
    return hidden.rename(hidden.with_name(hidden.name.removeprefix("."))), lock


def _free_ports(number: int) -> list[int]:
    sockets = [socket.socket() for _ in range(number)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports
