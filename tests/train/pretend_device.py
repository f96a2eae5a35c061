"""A device that computes nothing, on which one can see where the host would wait for a real one.

Tensors on it are torch's meta tensors: shapes without numbers. What takes a number from a device
to the host would wait for a GPU to come that far; here it is counted, and given a made-up number.
"""

import traceback
from contextlib import contextmanager, nullcontext
from functools import wraps
from pathlib import Path

import torch
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.strategies import SingleDeviceStrategy
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

ROOT = Path(__file__).parents[2]
WAITING = {
    "_local_scalar_dense": torch.ones((), dtype=torch.float64).item,  # item, float, bool
    "is_nonzero": lambda: True,
    "_linalg_check_errors": lambda: None,
}
"""What waits by itself, and what it is answered."""
OF_UNKNOWN_LENGTH = {"nonzero", "masked_select", "_unique2", "unique_dim", "bincount"}
"""What waits to learn how long its result is, which cannot be made up."""


class UnknownLengthError(Exception):
    """The host waits for a length that this device cannot make up."""


class PretendDevice(TorchDispatchMode):
    """Answers for the device and counts the waits, by ``file:function``."""

    def __init__(self):
        super().__init__()
        self.waits = None

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
        name = func.overloadpacket.__name__
        if not any(tensor.is_meta for tensor in tensors):
            if name == "_to_copy" and is_meta(kwargs.get("device")):
                self.send(args[0], kwargs)
            return func(*args, **kwargs)
        if name in WAITING:
            self.count()
            return WAITING[name]()
        if name == "_to_copy" and kwargs.get("device", None) == torch.device("cpu"):
            self.count()
            return torch.rand(args[0].shape).to(kwargs.get("dtype") or args[0].dtype)
        masks = name in ("index", "index_put_") and any(
            index is not None and index.dtype == torch.bool for index in args[1]
        )
        if masks or name in OF_UNKNOWN_LENGTH:
            self.count()
            raise UnknownLengthError(f"{name} at {place()}")
        if name == "copy_" and not args[0].is_meta:
            self.count()
            return args[0]
        return func(*args, **kwargs)

    def send(self, tensor, options):
        """A tensor goes to the device: without waiting only if asked so."""
        if not options.get("non_blocking"):
            self.count()

    def count(self):
        if self.waits is not None:
            self.waits[place()] += 1

    @contextmanager
    def observe(self, waits):
        """Stands in for ``benchmarks.step_clock.count_waits``."""
        self.waits = waits
        yield
        self.waits = None

    @contextmanager
    def in_use(self, monkeypatch):
        """Let ``l3r train`` compute on this device."""
        strategy = SingleDeviceStrategy(device=torch.device("meta"))
        monkeypatch.setattr("l3r.train.ranks.Ranks.strategy", lambda *_: strategy)
        monkeypatch.setattr(CPUAccelerator, "setup_device", lambda *_: None)
        monkeypatch.setattr(torch.Tensor, "is_pinned", lambda *_: True)  # as beside a GPU
        # Neither torch's fused AdamW nor its autocast knows the device.
        monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
        monkeypatch.setattr(
            "l3r.train.module.build_optimizer",
            lambda model, config: torch.optim.SGD(model.parameters(), lr=0.1, foreach=False),
        )
        monkeypatch.setattr("benchmarks.step_clock.count_waits", self.observe)
        for home, maker in ((torch, "tensor"), (torch, "as_tensor"), (torch.Tensor, "new_tensor")):
            monkeypatch.setattr(home, maker, self.sending(getattr(home, maker)))
        with self:
            yield

    def sending(self, maker):
        """Numbers that become a tensor of the device are sent there, and waited for."""

        @wraps(maker)
        def call(*args, **kwargs):
            made = maker(*args, **kwargs)
            if made.is_meta and made is not args[0]:
                self.count()
            return made

        return call


def is_meta(device):
    return device is not None and torch.device(device).type == "meta"


def place():
    """The innermost function of l3r that is under way; libraries wait on its behalf."""
    frames = [(Path(frame.filename), frame.name) for frame in traceback.extract_stack()]
    ours = [(path, name) for path, name in frames if (ROOT / "l3r") in path.parents]
    path, name = ours[-1] if ours else (ROOT / "elsewhere", "")
    return f"{path.relative_to(ROOT)}:{name}"
