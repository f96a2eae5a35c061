"""Signals that ask a run to stop: taken note of when they come, obeyed between two steps."""

import os
import shutil
import signal
import subprocess
import threading
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

SAVE_AND_REQUEUE = signal.SIGUSR1
SAVE_AND_END = signal.SIGTERM


class StopSignals:
    """Remembers SIGUSR1 and SIGTERM instead of dying of them, as long as its block lasts."""

    def __init__(self) -> None:
        self._seen: set[int] = set()
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "StopSignals":
        """Take the signals over."""
        self._before = {number: signal.getsignal(number) for number in _WATCHED}
        self.install()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give them back."""
        for number, handler in self._before.items():
            _set_handler(number, handler)

    def install(self) -> None:
        """Take them over again, from lightning, which sends to other processes in its handler."""
        for number in _WATCHED:
            _set_handler(number, self._note)

    def __contains__(self, number: signal.Signals) -> bool:
        return number in self._seen

    def __bool__(self) -> bool:
        """Whether any has come."""
        return bool(self._seen)

    def forget(self, number: signal.Signals) -> None:
        """Take a signal as obeyed."""
        self._seen.discard(number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._seen.add(number)


def name_job() -> str:
    """Name the SLURM job that this process is part of, of an array this task alone.

    The ID of one task of an array is that of the whole array as well.
    """
    if "SLURM_ARRAY_JOB_ID" in os.environ:
        return f"{os.environ['SLURM_ARRAY_JOB_ID']}_{os.environ['SLURM_ARRAY_TASK_ID']}"
    return os.environ["SLURM_JOB_ID"]


def requeue_job() -> str:
    """Send this SLURM job back to the queue.

    Containers have no ``scontrol``: there the file that ``L3R_REQUEUE_FILE`` names is made, which
    asks the job's script to do it.

    Returns:
        What happened, as the end of a sentence.
    """
    job = name_job()
    request = os.environ.get("L3R_REQUEUE_FILE")
    try:
        if request and shutil.which("scontrol") is None:
            Path(request).touch()
            return f"job {job} is to be requeued by its script and goes on from there"
        done = subprocess.run(
            ["scontrol", "requeue", job], capture_output=True, text=True, timeout=60
        )
        reason = done.stderr.strip() if done.returncode else ""
    except (OSError, subprocess.TimeoutExpired) as error:
        reason = str(error)
    if reason:
        return f"job {job} cannot be requeued ({reason}); submit the same command again"
    return f"job {job} is requeued and goes on from there"


_WATCHED = (SAVE_AND_REQUEUE, SAVE_AND_END)


def _set_handler(number: signal.Signals, handler: Any) -> None:
    if threading.current_thread() is threading.main_thread():
        signal.signal(number, handler)
