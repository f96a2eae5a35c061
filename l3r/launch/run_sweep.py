"""Do the runs of a sweep, each step as a process of its own, so that a crash costs one run."""

import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from l3r.config.check import require
from l3r.errors import ConfigError, LaunchError
from l3r.files import write_atomic
from l3r.launch.expand import Run, Sweep
from l3r.launch.run_lock import RunLock
from l3r.launch.run_state import FAILURE, LOG, OVER, RunState, read_state
from l3r.launch.score_file import scoring_request
from l3r.launch.slurm import job_is_leaving
from l3r.launch.sweep_progress import SweepProgress
from l3r.launch.twins import TAKEN_FROM, adopt_twin
from l3r.train.signals import requeue_job

_POLL_SECONDS = 0.2
_TAIL = 4096
_LEAVING = "this job goes back to the queue, and goes on from there later"
_L3R = (sys.executable, "-m", "l3r")
Stage = Literal["train", "score"]


@dataclass(kw_only=True)
class _Active:
    """A run that has a process."""

    run: Run
    stage: Stage
    process: subprocess.Popen[bytes]
    lock: RunLock
    began: float


class SweepRunner:
    """Trains and scores what is not finished, several runs at a time.

    Args:
        sweep: The sweep.
        jobs: Runs at a time; they share the cores unless OMP_NUM_THREADS says how many each takes.
        launcher: Words before ``l3r train``, such as those of srun.

    Raises:
        ConfigError: Fewer than one run at a time.
    """

    def __init__(self, sweep: Sweep, *, jobs: int = 1, launcher: Sequence[str] = ()) -> None:
        require(jobs >= 1, "--jobs", jobs, "1 or more")
        self.sweep = sweep
        self.jobs = jobs
        self.launcher = tuple(launcher)
        self.request = scoring_request(sweep)
        self.progress = SweepProgress()
        self.active: list[_Active] = []
        self.is_to_requeue = False
        self.is_asked = False

    def run(self, runs: Sequence[Run]) -> list[str]:
        """Do the runs that are not over; those that others are at are left to them.

        A run that fails is noted, and the next one begins.

        Returns:
            Names of those that are not over: they failed, wait for a checkpoint, or others are at
            them.

        Raises:
            KeyboardInterrupt: Asked to stop; the runs have saved where they are.
            LaunchError: The job is on its way back to the queue.
        """
        waiting = deque(runs)
        with self._signals(), self.progress.shown(runs):
            try:
                while waiting or self.active:
                    while waiting and len(self.active) < self.jobs:
                        self._begin(waiting.popleft())
                    self._look()
                    if self.is_to_requeue and not self.is_asked:
                        self._requeue()
            except BaseException:
                self._stop()
                raise
        return [run.name for run in runs if self._state(run).kind not in OVER]

    def _begin(self, run: Run) -> None:
        try:
            state = read_state(run, self.request)
        except ConfigError as error:
            # The folder is another run's, and stays as it is.
            self.progress.end(run, f"failed: {error}")
            return
        if state.kind in OVER or state.kind == "waiting":
            self.progress.end(run, state.describe())
            return
        lock = RunLock(run.folder)
        if not lock.acquire():
            self.progress.end(run, "another process is at it")
            return
        (run.folder / FAILURE).unlink(missing_ok=True)
        # Without the note of a failure it may turn out to be trained.
        state = self._state(run)
        if state.twin is not None and not (run.folder / "config.yaml").is_file():
            adopt_twin(run, state.twin)
            state = self._state(run)
        if state.kind in OVER:
            lock.release()
            self.progress.end(run, state.describe())
            return
        stage: Stage = "score" if state.kind == "trained" else "train"
        if stage == "train":
            # What it goes on to is no longer what it was taken from.
            (run.folder / TAKEN_FROM).unlink(missing_ok=True)
        self.active.append(self._start(run, stage, lock, time.monotonic()))

    def _start(self, run: Run, stage: Stage, lock: RunLock, began: float) -> _Active:
        if stage == "train":
            command = [*self.launcher, *_L3R, "train", *run.layers]
        else:
            sweep = (str(self.sweep.file), *self.sweep.extra, "--out", str(self.sweep.out))
            command = [*_L3R, "sweep", *sweep, "--score", run.name]
        threads = str(max(1, (os.cpu_count() or 1) // self.jobs))
        with (run.folder / LOG).open("ab") as log:
            log.write(f"$ {' '.join(command)}\n".encode())
            log.flush()
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={"OMP_NUM_THREADS": threads, **os.environ} if self.jobs > 1 else None,
                # Ctrl-C is for the sweep alone, which then asks its runs to save and end.
                start_new_session=True,
                # A run outlives a sweep that is killed, and so does its lock.
                pass_fds=lock.descriptors,
            )
        self.progress.begin(run, stage)
        return _Active(run=run, stage=stage, process=process, lock=lock, began=began)

    def _look(self) -> None:
        """Wait a moment, then take note of the processes that have ended."""
        time.sleep(_POLL_SECONDS)
        for active in list(self.active):
            code = active.process.poll()
            if code is not None:
                self.active.remove(active)
                self._settle(active, code)
        self.progress.update([active.run for active in self.active])

    def _settle(self, active: _Active, code: int) -> None:
        run = active.run
        if self.is_to_requeue:
            # It has requeued the job itself, but for one that was at its start or at its end.
            active.lock.release()
            raise LaunchError(_LEAVING if job_is_leaving() else requeue_job())
        if code == 0 and active.stage == "train":
            self.active.append(self._start(run, "score", active.lock, active.began))
            return
        if code and job_is_leaving():
            active.lock.release()
            raise LaunchError(_LEAVING)
        if code and self._state(run).kind not in OVER:
            write_atomic(run.folder / FAILURE, explain_exit(code, run.folder / LOG) + "\n")
        active.lock.release()
        seconds = time.monotonic() - active.began
        self.progress.end(run, f"{self._state(run).describe()}, {seconds:.0f} s")

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """Take SIGTERM as Ctrl-C and, in a SLURM job, SIGUSR1 as the time to requeue."""

        def interrupt(*_: object) -> None:
            raise KeyboardInterrupt

        def note(*_: object) -> None:
            self.is_to_requeue = True

        handlers = {signal.SIGTERM: interrupt}
        if "SLURM_JOB_ID" in os.environ:
            handlers[signal.SIGUSR1] = note
        before = {number: signal.signal(number, found) for number, found in handlers.items()}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _requeue(self) -> None:
        """Let a training save and requeue the job; where there is none, nothing is to be saved."""
        self.is_asked = True
        trainings = [active for active in self.active if active.stage == "train"]
        for active in trainings:
            active.process.send_signal(signal.SIGUSR1)
        if not trainings:
            raise LaunchError(requeue_job())

    def _stop(self) -> None:
        """Ask all processes to save and end, and wait for them; a second Ctrl-C kills them."""
        for active in self.active:
            active.process.terminate()
        try:
            for active in self.active:
                active.process.wait()
        except KeyboardInterrupt:
            for active in self.active:
                active.process.kill()
            raise
        finally:
            for active in self.active:
                active.lock.release()

    def _state(self, run: Run) -> RunState:
        """Read how far a run is; a folder that turns out to be another run's fails it alone."""
        try:
            return read_state(run, self.request)
        except ConfigError as error:
            return RunState(kind="failed", detail=str(error))


def explain_exit(code: int, log: Path) -> str:
    """Say why a process failed: its exit code, and the error line of l3r or the last line.

    Args:
        code: Exit code; negative: the number of the signal that killed it.
        log: What it said.
    """
    with log.open("rb") as stream:
        stream.seek(max(0, log.stat().st_size - _TAIL))
        said = stream.read().decode(errors="replace").splitlines()
    # Lines before the last command's are of another process.
    starts = [number for number, line in enumerate(said) if line.startswith("$ ")]
    lines = [line for line in said[starts[-1] + 1 if starts else 0 :] if line]
    errors = [line for line in lines if line.startswith("l3r ")] or lines[-1:]
    how = f"exit code {code}" if code >= 0 else f"killed by signal {-code}"
    return f"{how}: {errors[-1]}" if errors else how
