"""Which processes belong to a cluster, told from /proc, so that no pid can be mistaken.

A pid file may outlive its process, and its number may then be somebody else's; a process of a
cluster carries the cluster's folder with it.
"""

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

DAEMONS = ("slurmctld", "slurmd", "munged")
_STEP = "slurmstepd"


def find_processes(folder: Path, node: str | None = None) -> list[int]:
    """Give the pids of a cluster: its daemons, job steps and what jobs have started.

    Args:
        folder: The cluster's folder.
        node: Only steps and jobs of this node.
    """
    return [pid for pid in _pids() if _belongs(pid, folder, node)]


def end_processes(folder: Path, node: str | None = None, *, seconds: float = 20) -> None:
    """Kill what belongs to a cluster, or to one of its nodes, until nothing is left.

    Raises:
        RuntimeError: Something outlives SIGKILL.
    """
    deadline = time.monotonic() + seconds
    while found := find_processes(folder, node):
        for pid in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        if time.monotonic() > deadline:
            raise RuntimeError(f"{folder}: processes {found} do not end")
        time.sleep(0.05)


def _pids() -> Iterator[int]:
    return (int(path.name) for path in Path("/proc").iterdir() if path.name.isdecimal())


def _belongs(pid: int, folder: Path, node: str | None) -> bool:
    process = Path("/proc") / str(pid)
    # What is not ours, or ended while we looked, cannot be read.
    with contextlib.suppress(OSError):
        name = (process / "comm").read_text().strip()
        if name.startswith(_STEP):
            # It writes its title over its environment; what it has open is the node's log.
            logs = [slurmd_log(folder, node)] if node else list(folder.glob("slurmd-*.log"))
            opened = {link.readlink() for link in (process / "fd").iterdir()}
            return any(log in opened for log in logs)
        environment = _environment(process)
        if environment.get("SLURM_CONF") != str(folder / "slurm.conf"):
            return False
        if node:
            return environment.get("SLURMD_NODENAME") == node
        return name in DAEMONS or "SLURM_JOB_ID" in environment
    return False


def slurmd_log(folder: Path, node: str) -> Path:
    """Give the file that a node's daemon and its steps log to."""
    return folder / f"slurmd-{node}.log"


def _environment(process: Path) -> dict[str, str]:
    text = (process / "environ").read_bytes().decode(errors="replace")
    return dict(item.partition("=")[::2] for item in text.split("\0") if item)
