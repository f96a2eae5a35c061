"""Processes that work on a build."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

import torch


class InThisProcess(Executor):
    """Runs what is submitted at once."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run a call; its exception is raised when the result is asked for."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # noqa: BLE001 - handed on, as a pool does
            future.set_exception(error)
        return future


@contextmanager
def open_pool(num_workers: int) -> Iterator[Executor]:
    """Give an executor of so many processes; 0 works in this one.

    Workers end with this process however it ends, and at once when the block is interrupted. After
    another exception they finish what they have begun, and the rest is dropped.
    """
    if num_workers == 0:
        yield InThisProcess()
        return
    # Spawned: forked children of a process that has used threads can hang.
    context = multiprocessing.get_context("spawn")
    # Nothing is ever sent: its end, which this process holds alone, closes when the process ends.
    leash, hand = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(num_workers, context, initializer=_start, initargs=(leash,))
    try:
        with _interrupts_ignored():
            for _ in range(num_workers):
                pool.submit(_start_nothing)
        yield pool
    except KeyboardInterrupt:
        hand.close()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        hand.close()
        leash.close()


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Let processes that are started here ignore Ctrl-C, which a terminal sends to them as well."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def _start_nothing() -> None:
    """Do nothing: a pool starts a process when there is work for it."""


def _start(leash: Connection) -> None:
    # Work is shared out by process; threads that meet after every small operation only wait.
    torch.set_num_threads(1)
    threading.Thread(target=_end_with, args=(leash,), daemon=True).start()


def _end_with(leash: Connection) -> None:
    """End when the other end is closed: a worker would wait for work of a killed one for ever."""
    leash.poll(None)
    os._exit(1)
