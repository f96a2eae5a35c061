"""Weights, gradients and optimiser shared out over the processes (FSDP2)."""

import warnings
from collections.abc import Iterable, Mapping
from typing import Any, cast

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.core.optimizer import LightningOptimizer
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor, nn
from torch.distributed.device_mesh import DeviceMesh, init_device_mesh
from torch.distributed.fsdp import fully_shard
from torch.distributed.tensor import DTensor, distribute_tensor
from torch.nn.utils import get_total_norm

from l3r.model.alignment import CrossBlock
from l3r.model.blocks import DecoderBlock, EncoderBlock
from l3r.model.light3r import Light3R

SHARDED_BLOCKS = (EncoderBlock, DecoderBlock, CrossBlock)
"""What is gathered by itself. Every process must run each of them equally often in a step; a head
runs once for each orientation of its images, so heads are gathered with the rest of the network."""


class ShardedStrategy(DDPStrategy):
    """Each process keeps its share of every weight, gradient and moment of the optimiser.

    A block's weights are gathered when it runs and its gradients are averaged into shares. No
    mixed precision of FSDP's own: weights travel in float32 and autocast rounds what a block
    multiplies, so that norms and sums are what they are under DDP.

    Checkpoints are those of any other run: whole tensors, of which each process takes its share.
    """

    def configure_ddp(self) -> None:
        """Share out the network instead of wrapping it; the optimiser is made of the shares."""
        device = self.root_device
        network = self._network()
        strides = {name: value.stride() for name, value in network.named_parameters()}
        shard_network(network, init_device_mesh(device.type, (self.world_size,)))
        self._strides = {value: strides[name] for name, value in network.named_parameters()}

    def lightning_module_state_dict(self) -> dict[str, Any]:
        """Gather the weights on the first process; all must ask."""
        state = super().lightning_module_state_dict()
        return {name: collect(value, keep=self.is_global_zero) for name, value in state.items()}

    def optimizer_state(self, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
        """Gather the moments on the first process, laid out as the weights were; all must ask."""
        if isinstance(optimizer, LightningOptimizer):
            optimizer = optimizer.optimizer
        state = optimizer.state_dict()
        parameters = _parameters_of(optimizer)
        moments = {
            number: {
                name: self._gather_moment(value, parameters[number]) for name, value in own.items()
            }
            for number, own in state["state"].items()
        }
        return {**state, "state": moments}

    def load_optimizer_state_dict(self, checkpoint: Mapping[str, Any]) -> None:
        """Take this process's share of the moments."""
        for optimizer, state in zip(self.optimizers, checkpoint["optimizer_states"], strict=True):
            for number, parameter in enumerate(_parameters_of(optimizer)):
                moments = state["state"].get(number, {})
                for name, value in moments.items():
                    if value.shape == parameter.shape:
                        moments[name] = shard_like(value, parameter)
            optimizer.load_state_dict(state)

    def teardown(self) -> None:
        """Leave the shares where the processes can still gather them, for the last checkpoint."""
        assert self.cluster_environment is not None
        assert self.accelerator is not None
        self.cluster_environment.teardown()
        self.precision_plugin.teardown()
        self.accelerator.teardown()

    def _gather_moment(self, value: Tensor, parameter: nn.Parameter) -> Tensor:
        whole = collect(value, keep=self.is_global_zero)
        if whole.shape != parameter.shape:  # a count of steps, or another process keeps it
            return whole
        # Without FSDP a fused step pairs elements as they lie in memory.
        return torch.empty_strided(whole.shape, self._strides[parameter]).copy_(whole)

    def _network(self) -> Light3R:
        assert self.lightning_module is not None
        return cast(Light3R, self.lightning_module.get_submodule("model"))


class WholeNetwork(Callback):
    """Validates with a network of whole weights, gathered before: each process goes its own way.

    Stands behind what changes the weights for validation.
    """

    def __init__(self) -> None:
        self._sharded: nn.Module | None = None

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Put the whole network in the place of the sharded one."""
        self._sharded = pl_module.get_submodule("model")
        pl_module.set_submodule("model", gather_network(cast(Light3R, self._sharded)))

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Put the sharded one back."""
        assert self._sharded is not None
        pl_module.set_submodule("model", self._sharded)
        self._sharded = None


def shard_network(network: Light3R, mesh: DeviceMesh) -> None:
    """Share out a network's weights in place, block by block."""
    # The maps of a prediction are views; nothing writes into them.
    warnings.filterwarnings("ignore", message="FSDP2-wrapped module .* returned a view")
    for parameter in network.parameters():
        # FSDP knows one memory layout; convolutions are stored with their channels last.
        parameter.data = parameter.data.contiguous()
    for module in network.modules():
        if isinstance(module, SHARDED_BLOCKS):
            fully_shard(module, mesh=mesh)
    fully_shard(network, mesh=mesh)


def gather_network(network: Light3R) -> Light3R:
    """Make a network of a sharded one's whole weights, for inference; all processes must ask."""
    with torch.device("meta"):
        whole = Light3R(network.config, network.graph)
    state = {name: gather(value) for name, value in network.state_dict().items()}
    whole.load_state_dict(state, assign=True)
    return whole.eval()


def gather(value: Tensor) -> Tensor:
    """Put a tensor together from all processes, which must all ask; others come back as they are.

    Args:
        value: Shared out or not.
    """
    return value.full_tensor().detach() if isinstance(value, DTensor) else value


def collect(value: Tensor, *, keep: bool) -> Tensor:
    """Gather a tensor for a checkpoint, on the host: all of them may not fit on one device.

    Args:
        value: Shared out or not.
        keep: Whether this process wants it; else it gets an empty one.
    """
    if not isinstance(value, DTensor):
        return value
    whole = gather(value)
    return whole.cpu() if keep else whole.new_empty(0, device="cpu")


def shard_like(whole: Tensor, parameter: Tensor) -> Tensor:
    """Take this process's share of a tensor, where a parameter's lies; sends nothing."""
    if not isinstance(parameter, DTensor):
        return torch.empty_like(parameter.detach()).copy_(whole)
    mesh, placements = parameter.device_mesh, parameter.placements
    whole = whole.detach().to(parameter.device).contiguous()
    return distribute_tensor(whole, mesh, placements, src_data_rank=None)


def own_share(value: Tensor) -> Tensor:
    """Give the share of a tensor that lies here: all of it, if it is not shared out."""
    value = value.detach()
    return value.to_local() if isinstance(value, DTensor) else value


def total_norm(tensors: Iterable[Tensor]) -> Tensor:
    """Euclidean norm of tensors taken together; of shares, that of the whole on all processes."""
    return gather(get_total_norm(list(tensors)))


def _parameters_of(optimizer: torch.optim.Optimizer) -> list[nn.Parameter]:
    """All parameters, in the order in which a state dict numbers them."""
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]
