"""TensorFloat-32 where the network multiplies, and nowhere else."""

from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Callback
from torch import nn
from torch.autograd.graph import register_multi_grad_hook

from l3r.model.precision import set_tf32
from l3r.types import Prediction


class NetworkTf32(Callback):
    """Lets a GPU round what the network's float32 products are made of, in training steps.

    The switch is one of the whole process, so it is turned as a step goes along: the network
    leaves it off for trees and Procrustes, it stays off in the loss and in the backward pass of
    both, and is on again when that pass comes to the network. Validation is left as inference is.
    Nothing waits for the device.

    Args:
        enabled: Whether to round; else convolutions, which torch rounds by default, are exact too.
    """

    def __init__(self, *, enabled: bool) -> None:
        self.enabled = enabled

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Listen to when the network begins and ends."""
        network = pl_module.get_submodule("model")
        network.register_forward_pre_hook(self._begin)
        network.register_forward_hook(self._end)

    def on_after_backward(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Leave the step."""
        set_tf32(products=False, convolutions=True)  # torch's defaults

    def _begin(self, network: nn.Module, inputs: Any) -> None:
        if network.training:
            set_tf32(products=self.enabled, convolutions=self.enabled)

    def _end(self, network: nn.Module, inputs: Any, prediction: Prediction) -> None:
        if not network.training:
            return
        set_tf32(products=False, convolutions=False)
        maps = [value for value in vars(prediction.pairs).values() if value.requires_grad]
        # Whatever of the backward pass comes after the gradients of these is the network's.
        register_multi_grad_hook(maps, lambda _: self._begin(network, inputs))
