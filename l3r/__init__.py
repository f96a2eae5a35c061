"""Light3R-SfM: feed-forward Structure-from-Motion.

What is named below loads torch when it is first touched, so that ``l3r --help`` is quick.
"""

import importlib
from typing import TYPE_CHECKING, Any

from l3r.version import __version__

if TYPE_CHECKING:
    from l3r.inference.checkpoint import load_model
    from l3r.inference.reconstruct import reconstruct
    from l3r.model.light3r import Light3R

__all__ = ["Light3R", "__version__", "load_model", "reconstruct"]

_HOMES = {
    "Light3R": "l3r.model.light3r",
    "load_model": "l3r.inference.checkpoint",
    "reconstruct": "l3r.inference.reconstruct",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'l3r' has no attribute '{name}'")
