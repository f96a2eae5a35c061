"""The processes of a run: how many there are, which one this is, and what they agree on."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import lightning as L
import torch
import torch.distributed as dist
from lightning.fabric.plugins.environments.cluster_environment import ClusterEnvironment
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.pytorch.strategies import DDPStrategy, Strategy

from l3r.config import RunConfig, TrainConfig
from l3r.errors import ConfigError, L3RError, LaunchError
from l3r.train.sharding import ShardedStrategy
from l3r.types import Views

_PEER_FAILURE = re.compile(
    r"gloo|nccl|connection (reset|closed|refused)|timed out|broken pipe|rendezvous|socket", re.I
)


@dataclass(frozen=True, kw_only=True)
class Ranks:
    """The processes of a run, before any of them speaks to another."""

    rank: int
    """This process."""
    devices: int
    """Processes on each node."""
    num_nodes: int
    """Nodes."""
    is_srun: bool
    """Whether srun started them; else this process starts the others of its node."""

    @property
    def world_size(self) -> int:
        """Number of processes."""
        return self.devices * self.num_nodes

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes files and shows progress."""
        return self.rank == 0

    def environment(self) -> ClusterEnvironment:
        """Tell lightning who starts the processes, rather than let it guess from the machine."""
        return SLURMEnvironment(auto_requeue=False) if self.is_srun else LightningEnvironment()

    def strategy(self, config: TrainConfig) -> Strategy | str:
        """Build the strategy: gradients are averaged over processes; see :func:`batch_weight`."""
        if self.world_size == 1:
            return "auto"
        timeout = timedelta(minutes=config.timeout_minutes)
        if config.strategy == "fsdp":
            return ShardedStrategy(timeout=timeout)
        # No static_graph: it breaks off with accumulated gradients, and neither unused parameters
        # nor non-reentrant checkpoints need it.
        return DDPStrategy(
            timeout=timeout,
            find_unused_parameters=False,
            gradient_as_bucket_view=True,
            broadcast_buffers=False,
        )


def find_ranks(config: RunConfig, env: Mapping[str, str] = os.environ) -> Ranks:
    """Find out which process of how many this is.

    Args:
        config: Of the run.
        env: Environment; srun tells each process its place there.

    Raises:
        ConfigError: What srun started is not what the configuration asks for, or a step has fewer
            graphs than processes and batches.
    """
    train = config.train
    if int(env.get("SLURM_STEP_NUM_TASKS", "1")) > 1:
        ranks = _ranks_of_srun(train, env)
    else:
        devices, num_nodes = train.devices or 1, train.num_nodes or 1
        place = int(env.get("NODE_RANK", "0")), int(env.get("LOCAL_RANK", "0"))
        ranks = Ranks(
            rank=place[0] * devices + place[1], devices=devices, num_nodes=num_nodes, is_srun=False
        )
    parts = ranks.world_size * train.accumulate
    if config.data.graphs_per_step < parts:
        raise ConfigError(
            f"data.graphs_per_step is {config.data.graphs_per_step}, expected at least {parts}: "
            f"{ranks.world_size} devices, train.accumulate={train.accumulate} batches each"
        )
    return ranks


def _ranks_of_srun(train: TrainConfig, env: Mapping[str, str]) -> Ranks:
    tasks = env.get("SLURM_STEP_TASKS_PER_NODE", "")
    even = re.fullmatch(r"(\d+)(?:\(x(\d+)\))?", tasks)
    if even is None or "SLURM_NTASKS_PER_NODE" not in env:
        raise ConfigError(
            f"srun started {tasks} processes on the nodes, expected as many on each, asked for by "
            "--ntasks-per-node; submit with --nodes and --ntasks-per-node, not with --ntasks"
        )
    devices, num_nodes = int(even[1]), int(even[2] or 1)
    asked = (train.devices or devices, train.num_nodes or num_nodes)
    if asked != (devices, num_nodes):
        raise ConfigError(
            f"train.devices={asked[0]}, train.num_nodes={asked[1]}, and srun started {devices} "
            f"processes on each of {num_nodes} nodes; make --ntasks-per-node and --nodes the same, "
            "or leave both keys null"
        )
    return Ranks(rank=int(env["SLURM_PROCID"]), devices=devices, num_nodes=num_nodes, is_srun=True)


class Agreement:
    """Small decisions that all processes take alike, at the same place of a step.

    They go over gloo, so that nobody waits for a device. With one process everything is agreed.
    """

    def __init__(self) -> None:
        self._group: Any = None

    def open(self, timeout_minutes: float) -> None:
        """Connect, on all processes together; before it, and with one process, nothing is sent."""
        if dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1:
            timeout = timedelta(minutes=timeout_minutes)
            self._group = dist.new_group(backend="gloo", timeout=timeout)

    def any(self, flags: Sequence[bool]) -> list[bool]:
        """Tell, for each flag, whether any process raised it."""
        if self._group is None:
            return list(flags)
        shared = torch.tensor(flags, dtype=torch.uint8)
        dist.all_reduce(shared, op=dist.ReduceOp.MAX, group=self._group)
        return [bool(flag) for flag in shared]

    def gather(self, value: Any) -> list[Any]:
        """Give every process the values of all, by rank; of plain objects only."""
        if self._group is None:
            return [value]
        values = [None] * dist.get_world_size(self._group)
        dist.all_gather_object(values, value, group=self._group)
        return values


def batch_weight(trainer: L.Trainer, batch: Views, config: RunConfig) -> float:
    """Weight of a batch's means in those of its step; 1 where all batches have as many graphs.

    The mean of the weighted means, over the batches of all processes, is that over all graphs.
    """
    num_batches = trainer.world_size * trainer.accumulate_grad_batches
    return len(batch.key) * num_batches / config.data.graphs_per_step


def step_is_whole(trainer: L.Trainer, batch_idx: int) -> bool:
    """Tell at the end of a batch whether it was the last of its optimisation step."""
    return (batch_idx + 1) % trainer.accumulate_grad_batches == 0


def explain_failure(error: Exception, ranks: Ranks, config: TrainConfig) -> L3RError | None:
    """Make one line of what torch says when another process of the run is gone or hangs.

    Returns:
        None where the error is about something else.
    """
    is_of_peers = isinstance(error, dist.DistError) or (
        isinstance(error, RuntimeError) and _PEER_FAILURE.search(str(error))
    )
    if ranks.world_size == 1 or not is_of_peers:
        return None
    found = str(error).strip().split("\n")[0]
    return LaunchError(
        f"process {ranks.rank} of {ranks.world_size} lost another one, which died or did not "
        f"answer for train.timeout_minutes={config.timeout_minutes:g} ({found}); what that one "
        "wrote says why; the same command goes on from the last checkpoint"
    )
