"""Processes of a run as threads of this one, for what they tell each other."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

from l3r.train.ranks import Agreement


class ThreadAgreement(Agreement):
    """Each thread gets the values of all once all have come."""

    def __init__(self, rank, parts, barrier):
        super().__init__()
        self.rank, self.parts, self.barrier = rank, parts, barrier

    def gather(self, value):
        self.parts[self.rank] = value
        self.barrier.wait(timeout=10)
        found = list(self.parts)
        self.barrier.wait(timeout=10)
        return found


def run_together(run, world_size):
    """Call ``run(rank, agreement)`` for each process; gives what they return."""
    parts, barrier = [None] * world_size, Barrier(world_size)

    def call(rank):
        return run(rank, ThreadAgreement(rank, parts, barrier))

    with ThreadPoolExecutor(world_size) as pool:
        return list(pool.map(call, range(world_size)))
